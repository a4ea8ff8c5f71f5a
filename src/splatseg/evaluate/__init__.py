"""How good a result is: pure measures, and scenes held against truth on chosen views."""

from splatseg.evaluate.held_out import BinaryReport as BinaryReport
from splatseg.evaluate.held_out import PhotographReport as PhotographReport
from splatseg.evaluate.held_out import SemanticReport as SemanticReport
from splatseg.evaluate.held_out import ViewScore as ViewScore
from splatseg.evaluate.held_out import evaluate_binary as evaluate_binary
from splatseg.evaluate.held_out import evaluate_photographs as evaluate_photographs
from splatseg.evaluate.held_out import evaluate_semantic as evaluate_semantic
from splatseg.evaluate.held_out import picture_and_photograph as picture_and_photograph
from splatseg.evaluate.metrics import BinaryScore as BinaryScore
from splatseg.evaluate.metrics import Confusion as Confusion
from splatseg.evaluate.metrics import SemanticScore as SemanticScore
from splatseg.evaluate.metrics import binary_score as binary_score
from splatseg.evaluate.metrics import per_image_miou as per_image_miou
from splatseg.evaluate.metrics import psnr as psnr
from splatseg.evaluate.metrics import semantic_score as semantic_score
from splatseg.evaluate.metrics import ssim as ssim
