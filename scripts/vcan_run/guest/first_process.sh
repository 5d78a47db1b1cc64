#!/bin/sh
# The guest's first process, under User Mode Linux and QEMU alike: it makes the system complete, brings vcan0 and vcan1
# up, runs the command and switches the guest off.
#
# It lies in the session's folder, which the guest sees at the same path as the host, and finds there
#   backend    uml or qemu
#   busybox    a static one, for mount, insmod and ip: the host's own may be missing or think of the host
#   modules    kernel modules to load, in order, one a line, with their options
#   command    the caller's command, as a script
#   tmp/       becomes the command's TMPDIR
# It leaves there
#   started    as soon as it runs,
#   status     the command's exit status,
#   failure    or else why the command was not run.

folder=${0%/*}
busybox=$folder/busybox
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
read -r backend <"$folder/backend"
: >"$folder/started"

mount() { "$busybox" mount "$@"; }

switch_off() {
	sync
	echo o >/proc/sysrq-trigger # there is no init system to ask
	sleep 30                    # the kernel panics if its first process ends
}

fail() {
	echo "$*" >>"$folder/failure"
	switch_off
}

# What an init system would mount. All of it hides the host's, so that nothing here reaches the host's /run or /dev/shm.
if [ "$backend" = uml ]; then # QEMU's initramfs has done this
	mount -t proc proc /proc
	mount -t sysfs sys /sys
fi
mkdir -p /dev/shm /dev/pts # in the guest's own /dev, which the kernel made
mount -t tmpfs -o mode=1777 tmpfs /dev/shm
mount -t devpts devpts /dev/pts
mount -t tmpfs tmpfs /run
mount -t tmpfs -o mode=1777 tmpfs "$folder/tmp"
[ -e /dev/ptmx ] || ln -s pts/ptmx /dev/ptmx
if [ ! -e /dev/fd ]; then
	ln -s /proc/self/fd /dev/fd
	ln -s fd/0 /dev/stdin
	ln -s fd/1 /dev/stdout
	ln -s fd/2 /dev/stderr
fi

while read -r module options; do
	# shellcheck disable=SC2086 # several options are several words
	"$busybox" insmod "$module" $options || fail "cannot load $module"
done <"$folder/modules"

"$busybox" ip link set lo up
for interface in vcan0 vcan1; do
	# 72 bytes: CAN FD frames too
	"$busybox" ip link add $interface type vcan &&
		"$busybox" ip link set $interface mtu 72 &&
		"$busybox" ip link set $interface up ||
		fail "cannot make $interface"
done

# The devices that lead to the caller's stdout and stderr.
case $backend in
uml)
	stdout=/dev/tty1 stderr=/dev/tty2
	exec 8<>$stdout 9<>$stderr # open until the end: a terminal forgets its settings with the last close
	"$busybox" stty raw -echo <&8 # raw: no carriage returns
	"$busybox" stty raw -echo <&9
	;;
qemu)
	for port in /sys/class/virtio-ports/*; do
		case $(cat "$port/name") in
		out) stdout=/dev/${port##*/} ;;
		err) stderr=/dev/${port##*/} ;;
		esac
	done
	;;
esac

# The command writes to pipes: it would treat a terminal differently, and a virtio port cannot be opened twice, as
# programs do that write to /dev/stderr.
mkfifo /run/stdout /run/stderr
cat /run/stdout >"$stdout" 8>&- 9>&- &
out=$!
cat /run/stderr >"$stderr" 8>&- 9>&- &
err=$!
sh "$folder/command" </dev/null >/run/stdout 2>/run/stderr 8>&- 9>&-
status=$?

# Let the rest of the output through, but do not wait for long: what the command left running may hold the pipes open.
for attempt in 1 2 3 4 5 6 7 8 9 10; do
	kill -0 $out 2>/dev/null || kill -0 $err 2>/dev/null || break
	sleep 0.2
done
sleep 0.1 # from the device to the host

echo $status >"$folder/status"
switch_off
