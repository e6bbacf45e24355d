"""Cores, memory, devices and files of the machine that this process may use, and settings of the process."""
