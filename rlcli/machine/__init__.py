"""Resources of the machine that this process may use, and settings of its process and libraries."""
