/*
 * Lets the clock of User Mode Linux stand still while the guest does. Loaded into it with LD_PRELOAD.
 *
 * User Mode Linux is a program among others: the host takes the processor away from it for milliseconds, a busy or
 * virtual host for tenths of a second, and nothing in the guest happens meanwhile. Its clock would go on, so that to
 * the programs in it devices seem to be silent and threads to be late. (The guest's own remedy, time-travel mode, is
 * not in Debian's kernel.)
 *
 * So the guest's clock counts real time only while the guest waits, and not beyond what it waits for. While it works,
 * it reads the clock with each system call or switch of threads, every 10 to 50 us. Of that 1 us is counted, about
 * what a processor of its own would take: the rest is the host's doing, or User Mode Linux's, or a program's that
 * computes. The timers that wake the guest are the host's and may now come early; the guest then sets them again.
 *
 * With VCAN_RUN_SKIP_IDLE in the environment, the guest does not wait for its timers: its clock jumps to them.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <signal.h>
#include <stdlib.h>
#include <time.h>

#define NS_PER_S 1000000000LL
#define MOST_AT_ONCE_NS 1000LL
#define NEVER_NS -1LL

static volatile long long guest_ns, read_ns, wake_ns = NEVER_NS; /* the latter two in real time */
static volatile sig_atomic_t waiting, reading;

static void *real(const char *name)
{
	return dlsym(RTLD_NEXT, name);
}

static int real_clock(clockid_t clock, struct timespec *now)
{
	static int (*function)(clockid_t, struct timespec *);

	if (!function)
		function = real("clock_gettime");
	return function(clock, now);
}

static long long real_ns(void)
{
	struct timespec now;

	real_clock(CLOCK_MONOTONIC, &now);
	return now.tv_sec * NS_PER_S + now.tv_nsec;
}

static long long read_guest_clock(void)
{
	if (reading) /* in the handler of a signal that has interrupted this */
		return guest_ns;
	reading = 1;

	long long now_ns = real_ns(), passed_ns = now_ns - read_ns, most_ns = MOST_AT_ONCE_NS;

	if (waiting && wake_ns == NEVER_NS)
		most_ns = passed_ns;
	else if (waiting && wake_ns > read_ns)
		most_ns += wake_ns - read_ns;
	if (!guest_ns)
		guest_ns = now_ns;
	else
		guest_ns += passed_ns < most_ns ? passed_ns : most_ns;
	read_ns = now_ns;
	reading = 0;
	return guest_ns;
}

int clock_gettime(clockid_t clock, struct timespec *now)
{
	if (clock != CLOCK_MONOTONIC)
		return real_clock(clock, now);

	long long now_ns = read_guest_clock();

	now->tv_sec = now_ns / NS_PER_S;
	now->tv_nsec = now_ns % NS_PER_S;
	return 0;
}

/* The guest has one timer, and sets it relative to now. */
static timer_t the_timer;

static int real_timer(timer_t timer, int flags, const struct itimerspec *wanted, struct itimerspec *old)
{
	static int (*function)(timer_t, int, const struct itimerspec *, struct itimerspec *);

	if (!function)
		function = real("timer_settime");
	return function(timer, flags, wanted, old);
}

int timer_settime(timer_t timer, int flags, const struct itimerspec *wanted, struct itimerspec *old)
{
	long long after_ns = wanted->it_value.tv_sec * NS_PER_S + wanted->it_value.tv_nsec;

	the_timer = timer;
	wake_ns = after_ns ? real_ns() + after_ns : NEVER_NS;
	return real_timer(timer, flags, wanted, old);
}

static void jump(void)
{
	static const struct itimerspec at_once = { .it_value = { .tv_nsec = 1 } };

	if (wake_ns > read_ns)
		guest_ns += wake_ns - read_ns;
	wake_ns = read_ns;
	real_timer(the_timer, 0, &at_once, NULL); /* its signal is blocked until the guest sleeps */
}

/* Called where the guest has nothing to do. */
int sigsuspend(const sigset_t *mask)
{
	static int (*function)(const sigset_t *);
	static int skip = -1;
	int result;

	if (!function)
		function = real("sigsuspend");
	if (skip < 0)
		skip = getenv("VCAN_RUN_SKIP_IDLE") != NULL;
	read_guest_clock();
	waiting = 1;
	if (skip && wake_ns != NEVER_NS)
		jump();
	result = function(mask);
	read_guest_clock();
	waiting = 0;
	return result;
}
