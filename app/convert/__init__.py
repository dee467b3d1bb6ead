"""READ: a stored version -> a map in the wanted format.

``recipe`` says how a map would be made (cheaply, from the version's manifest), ``make`` makes it, ``cache`` keeps it
and lets one of many askers do the work, ``pool`` is where the work is done.
"""

from app.convert.files import Converted, offline, written
from app.convert.maps import Maps
from app.convert.recipe import Recipe
from app.pool import Pool, WorkerDied

__all__ = ["Converted", "Maps", "Pool", "Recipe", "WorkerDied", "offline", "written"]
