"""A small scene for lifting and label maps in memory, see `support.lifting`."""

from support.backends import each_backend as each_backend
from support.backends import pytest_generate_tests as pytest_generate_tests
from support.lifting import BACKEND as BACKEND
from support.lifting import BARREL as BARREL
from support.lifting import Maps as Maps
from support.lifting import camera_at as camera_at
from support.lifting import gaussians_at as gaussians_at
from support.lifting import matrix_of as matrix_of
from support.lifting import random_gaussians as random_gaussians
from support.lifting import random_maps as random_maps
from support.lifting import views as views
