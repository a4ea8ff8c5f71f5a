"""2D models behind small protocols: recorded ones, stand-ins without weights, and other people's.

Models see photographs and give evidence; they never see Gaussians. See ``docs/models.md``.
"""

from splatseg.models._cache import ModelCache as ModelCache
from splatseg.models._protocols import AutomaticMasks as AutomaticMasks
from splatseg.models._protocols import Boxes as Boxes
from splatseg.models._protocols import DeepFeatures as DeepFeatures
from splatseg.models._protocols import DenseFeatures as DenseFeatures
from splatseg.models._protocols import Embedding as Embedding
from splatseg.models._protocols import GroundedBoxes as GroundedBoxes
from splatseg.models._protocols import MaskTracker as MaskTracker
from splatseg.models._protocols import Model as Model
from splatseg.models._protocols import Panoptic as Panoptic
from splatseg.models._protocols import PanopticSegments as PanopticSegments
from splatseg.models._protocols import Prompt as Prompt
from splatseg.models._protocols import PromptableMasks as PromptableMasks
from splatseg.models._protocols import SemanticLabels as SemanticLabels
from splatseg.models._protocols import TextFeatures as TextFeatures
from splatseg.models._record import SeenEvidence as SeenEvidence
from splatseg.models._record import record_evidence as record_evidence
from splatseg.models._registry import ENTRY_POINT_GROUP as ENTRY_POINT_GROUP
from splatseg.models._registry import find_model as find_model
from splatseg.models._registry import model_names as model_names
from splatseg.models.recorded import recorded_model as recorded_model
