"""Preload the modules that every first conversion needs (imported for its effect).

Worker processes are forked from one that has imported this. Native code of derivations (numba) is excluded: most
servers never need it.
"""

import numpy as np
from PIL import Image

from app import derive, formats, generate
from app.convert import files, worker
from app.model.frame import Datum
from app.model.geodesy import distance, local_frame

formats.all_formats()
derive.all_derivations()
generate.all_generators()
Image.preinit()
local_frame(Datum(0.0, 0.0)).to_local(np.unique(np.zeros((1, 2)), axis=0))
distance((0.0, 0.0), (0.0, 1.0))

__all__ = ["files", "worker"]
