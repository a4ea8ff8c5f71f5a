"""Training on rows of W: sampled pixels, batches, row-wise Adam, checkpoints, early stopping.

With the geometry frozen, rows of W never change. A `RowSampler` draws pixels of views and keeps
their rows; a `Model` says what it learns and how a batch is scored; `train` does the rest.
"""

from splatseg.lift.training._options import Moving as Moving
from splatseg.lift.training._options import RowTrainingOptions as RowTrainingOptions
from splatseg.lift.training._options import Sampling as Sampling
from splatseg.lift.training._options import SamplingOptions as SamplingOptions
from splatseg.lift.training._options import Schedule as Schedule
from splatseg.lift.training._options import TrainingOptions as TrainingOptions
from splatseg.lift.training._sampler import Batch as Batch
from splatseg.lift.training._sampler import DrawnRows as DrawnRows
from splatseg.lift.training._sampler import RowSampler as RowSampler
from splatseg.lift.training._sampler import held_out_views as held_out_views
from splatseg.lift.training._state import AdamConstants as AdamConstants
from splatseg.lift.training._state import RowAdam as RowAdam
from splatseg.lift.training._state import RowMoments as RowMoments
from splatseg.lift.training._state import TrainingSummary as TrainingSummary
from splatseg.lift.training._state import training_summary as training_summary
from splatseg.lift.training._targets import LabelTargets as LabelTargets
from splatseg.lift.training._targets import MaskSets as MaskSets
from splatseg.lift.training._targets import MaskTargets as MaskTargets
from splatseg.lift.training._targets import PixelChoice as PixelChoice
from splatseg.lift.training._targets import Ragged as Ragged
from splatseg.lift.training._targets import Target as Target
from splatseg.lift.training._targets import Targets as Targets
from splatseg.lift.training._targets import TargetSource as TargetSource
from splatseg.lift.training._targets import TensorBudget as TensorBudget
from splatseg.lift.training._train import Model as Model
from splatseg.lift.training._train import Parameter as Parameter
from splatseg.lift.training._train import TrainingResult as TrainingResult
from splatseg.lift.training._train import Values as Values
from splatseg.lift.training._train import train as train
