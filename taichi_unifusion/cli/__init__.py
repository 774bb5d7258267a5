"""`unifusion`: one file a command."""

import os

# Taichi computes. NumPy's linear algebra is small: threads for it wait for each other at full speed,
# which takes seconds for 10 ms of work where other programs run. Read when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
