"""One thread for PyTorch: more wait for each other by spinning, which beside other tests takes six times as long."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when PyTorch is loaded, after this
