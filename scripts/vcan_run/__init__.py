"""Runs a command on a Linux kernel that has SocketCAN: this machine's, or that of a virtual machine.

A virtual machine sees this machine's files at the same paths, so a command runs there as it would here, from the same
virtual environment, in the same directory.

| module | what it does |
|---|---|
| `cli` | options, choice of the backend, exit statuses |
| `setup` | fetches kernels and tools from the distribution's packages into a cache |
| `native`, `uml`, `qemu` | the three backends |
| `session` | what all virtual machines share: the files that the guest runs from, its output and its end |
| `kernel_modules` | load order of kernel modules |
| `guest/` | the scripts that run inside the guest |
| `uml_xsave.c` | lets User Mode Linux start on CPUs whose register state is larger than it knows |
| `uml_clock.c` | lets its clock stand still while the host does not let it run |
"""
