#!/bin/busybox sh
# First program of the QEMU guest, from its initramfs: loads the drivers (in /modules, named in load order) without
# which the host's files cannot be reached, makes these files the root, and goes on with the program that stands in
# /first_process.

/bin/busybox mkdir -p /proc /sys /dev /root
/bin/busybox --install -s /bin
export PATH=/bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in /modules/*; do
	insmod "$module"
done
# cache=loose: nobody changes files meanwhile, and Python's start is many small reads
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose host /root
for folder in /proc /sys /dev; do
	mount --move $folder /root$folder
done
exec switch_root /root "$(cat /first_process)"
