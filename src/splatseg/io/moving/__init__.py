"""Moving things left out: boxes of them from files, and masks of what views show of them."""

from splatseg.io.moving._json import write_moving as write_moving
from splatseg.io.moving._masks import MovingOptions as MovingOptions
from splatseg.io.moving._masks import mask_moving as mask_moving
from splatseg.io.moving._read import read_moving as read_moving
from splatseg.io.moving._sources import StaticScans as StaticScans
from splatseg.io.moving._times import view_times as view_times
