"""What things are: plain data and closed-form geometry. No files, no kernels."""

from splatseg.core.camera import Camera as Camera
from splatseg.core.camera import CameraModel as CameraModel
from splatseg.core.evidence import UNLABELLED as UNLABELLED
from splatseg.core.evidence import FeatureMap as FeatureMap
from splatseg.core.evidence import LabelMap as LabelMap
from splatseg.core.evidence import MaskSet as MaskSet
from splatseg.core.gaussians import Gaussians as Gaussians
from splatseg.core.layers import Features as Features
from splatseg.core.layers import Labels as Labels
from splatseg.core.layers import Selection as Selection
from splatseg.core.rigid import Similarity as Similarity
from splatseg.core.rle import Rle as Rle
from splatseg.core.scene import Capture as Capture
from splatseg.core.scene import ClassInfo as ClassInfo
from splatseg.core.scene import ClassTable as ClassTable
from splatseg.core.scene import PointCloud as PointCloud
from splatseg.core.scene import Scene as Scene
from splatseg.core.scene import View as View
