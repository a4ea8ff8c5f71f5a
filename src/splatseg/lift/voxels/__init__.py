"""Open-vocabulary sparse voxels: features of pixels on the voxels that their rays hit."""

from splatseg.lift.voxels.assignment import AssignmentOptions as AssignmentOptions
from splatseg.lift.voxels.assignment import VoxelRows as VoxelRows
from splatseg.lift.voxels.assignment import assign_voxels as assign_voxels
from splatseg.lift.voxels.filtering import FilterOptions as FilterOptions
from splatseg.lift.voxels.filtering import surface_gaussians as surface_gaussians
from splatseg.lift.voxels.grid import GridIndex as GridIndex
from splatseg.lift.voxels.grid import voxelise as voxelise
from splatseg.lift.voxels.grid import voxelise_to_count as voxelise_to_count
from splatseg.lift.voxels.lifting import HitOptions as HitOptions
from splatseg.lift.voxels.lifting import LiftedVoxels as LiftedVoxels
from splatseg.lift.voxels.lifting import lift_to_voxels as lift_to_voxels
from splatseg.lift.voxels.lifting import optical_depths as optical_depths
from splatseg.lift.voxels.storage import products as products
from splatseg.lift.voxels.storage import store as store
from splatseg.lift.voxels.surface import surface_points as surface_points
from splatseg.lift.voxels.words import LastLayers as LastLayers
from splatseg.lift.voxels.words import TableWords as TableWords
from splatseg.lift.voxels.words import VoxelWords as VoxelWords
