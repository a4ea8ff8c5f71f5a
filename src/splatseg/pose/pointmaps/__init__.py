"""Cameras and a dense cloud from pointmaps of pairs of photographs; see ``docs/poses.md``."""

from splatseg.pose.pointmaps._options import Alignment as Alignment
from splatseg.pose.pointmaps._options import PairGraph as PairGraph
from splatseg.pose.pointmaps._options import PointmapOptions as PointmapOptions
from splatseg.pose.pointmaps._recover import PointmapResult as PointmapResult
from splatseg.pose.pointmaps._recover import recover_from_pointmaps as recover_from_pointmaps
from splatseg.pose.pointmaps._report import PointmapReport as PointmapReport
