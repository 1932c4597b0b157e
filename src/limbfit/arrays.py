"""The array types of annotations; docstrings give the shapes."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Index = NDArray[np.int32]  # short: what the compiled kernels take
Mask = NDArray[np.bool_]
