"""Rights of a worker process: the files that it can read and the system calls that it can make."""
