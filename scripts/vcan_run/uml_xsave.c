/*
 * Lets User Mode Linux start on CPUs with AMX. Loaded into it with LD_PRELOAD.
 *
 * User Mode Linux runs guest processes under ptrace and saves and restores their registers with PTRACE_GETREGSET and
 * PTRACE_SETREGSET. Before Linux 6.13 it keeps 2696 bytes for the extended state (XSAVE), which was enough for
 * AVX-512. With AMX the state has 11008 bytes. Reading a part of it is allowed, but writing is all or nothing: the
 * host refuses a shorter state with EFAULT, and the guest dies at its first process with
 * "ptrace set fp regs failed".
 *
 * So each write that is too short is filled up with zeros. Zero bytes beyond what User Mode Linux knows mean what it
 * means anyway: the state's header, which lies in the part that it has, says which components are in use.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

#define NT_X86_XSTATE 0x202 /* linux/elf.h */

typedef long ptrace_function(enum __ptrace_request, ...);

/* glibc declares ptrace with variable arguments; all requests that User Mode Linux makes have these three. */
long ptrace(enum __ptrace_request request, ...)
{
	static ptrace_function *real_ptrace;
	static unsigned char state[65536] __attribute__((aligned(64)));
	static size_t state_size; /* what this CPU has */
	va_list arguments;

	va_start(arguments, request);
	long pid = va_arg(arguments, long);
	void *address = va_arg(arguments, void *);
	void *data = va_arg(arguments, void *);
	va_end(arguments);

	if (!real_ptrace)
		real_ptrace = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");

	if (request == PTRACE_SETREGSET && (long)address == NT_X86_XSTATE) {
		struct iovec *given = data;
		struct iovec whole = { state, sizeof state };

		if (!state_size) {
			if (real_ptrace(PTRACE_GETREGSET, pid, address, &whole) < 0)
				return -1;
			state_size = whole.iov_len;
			memset(state, 0, sizeof state);
		}
		if (given->iov_len < state_size) {
			memcpy(state, given->iov_base, given->iov_len);
			whole.iov_len = state_size;
			return real_ptrace(request, pid, address, &whole);
		}
	}
	return real_ptrace(request, pid, address, data);
}
