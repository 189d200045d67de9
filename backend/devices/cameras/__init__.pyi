from .frames import PictureFilter as PictureFilter
from .frames import link_fault as link_fault
from .sources import PictureSource as PictureSource
from .sources import open_source as open_source
