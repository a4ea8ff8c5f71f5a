"""2D models behind small protocols: recorded ones, stand-ins without weights, and other people's.

Models see images and give evidence; they never see Gaussians. See ``docs/models.md``.
"""

from splatseg.models._record import DescribedEvidence as DescribedEvidence
from splatseg.models._record import EvidenceRequest as EvidenceRequest
from splatseg.models._record import record_evidence as record_evidence
from splatseg.models._registry import ENTRY_POINT_GROUP as ENTRY_POINT_GROUP
from splatseg.models._registry import find_family as find_family
from splatseg.models._registry import find_model as find_model
from splatseg.models._registry import model_names as model_names
from splatseg.models._registry import model_summary as model_summary
from splatseg.models._tracked import TrackingOptions as TrackingOptions
from splatseg.models._weights import Checkpoint as Checkpoint
from splatseg.models._weights import Loading as Loading
from splatseg.models._weights import LoadOptions as LoadOptions
from splatseg.models._weights import ModelFamily as ModelFamily
from splatseg.models._weights import What as What
from splatseg.models.recorded import recorded_model as recorded_model
