"""The load and the arm that carries it."""

import numpy as np

# The arrays of a plan are of a size that glibc gives back to the system when they are freed, and a tenth to a quarter
# of a plan's time went into getting the same pages again. It keeps what is smaller than the largest block that was ever
# freed, up to 32 MB (mallopt(3), M_MMAP_THRESHOLD), so one is freed here; nobody has written to it, so it was never
# there. Other libraries of C do with it what they like.
_untouched = np.empty(31 << 20, dtype=np.uint8)
del _untouched
