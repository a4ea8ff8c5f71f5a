"""Moving things left out: boxes of them from files, and masks of what views show of them."""

from splatseg.io.moving.boxes import read_moving as read_moving
from splatseg.io.moving.boxes import write_moving as write_moving
from splatseg.io.moving.views import MovingOptions as MovingOptions
from splatseg.io.moving.views import StaticScans as StaticScans
from splatseg.io.moving.views import mask_moving as mask_moving
from splatseg.io.moving.views import view_times as view_times
