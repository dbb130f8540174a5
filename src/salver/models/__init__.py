"""The load and the arm that carries it."""

import numpy as np

# glibc returns arrays of the size that plans use to the system when they are freed, and getting the same pages again
# took a tenth to a quarter of the planning time. It keeps blocks smaller than the largest block that was ever freed, up
# to 32 MB (mallopt(3), M_MMAP_THRESHOLD), so one such block is freed here; it uses no memory, because nothing is
# written to it. Other C libraries are not affected.
_untouched = np.empty(31 << 20, dtype=np.uint8)
del _untouched
