"""Several robots' grids of one place: where each lies in the frame of the first, and one grid made of all."""

from app.model.stitching.mosaic import SEAMS, Mosaic, Seam, merge_cells
from app.model.stitching.placing import MAX_GRIDS, Bounds, Placement, Start, place_grids

__all__ = ["MAX_GRIDS", "SEAMS", "Bounds", "Mosaic", "Placement", "Seam", "Start", "merge_cells", "place_grids"]
