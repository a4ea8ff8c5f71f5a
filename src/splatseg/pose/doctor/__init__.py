"""The doctor: finds the usual faults of posed captures and corrects them."""

from splatseg.pose.doctor._corrections import PointCorrection as PointCorrection
from splatseg.pose.doctor._corrections import axis_rotations as axis_rotations
from splatseg.pose.doctor._diagnose import DoctorOptions as DoctorOptions
from splatseg.pose.doctor._diagnose import diagnose as diagnose
from splatseg.pose.doctor._diagnose import find_points as find_points
from splatseg.pose.doctor._diagnosis import Diagnosis as Diagnosis
from splatseg.pose.doctor._diagnosis import Fault as Fault
from splatseg.pose.doctor._files import Read as Read
from splatseg.pose.doctor._files import declared_transforms as declared_transforms
from splatseg.pose.doctor._files import read_for_doctor as read_for_doctor
from splatseg.pose.doctor._files import write_corrected as write_corrected
from splatseg.pose.doctor._judge import describe_move as describe_move
from splatseg.pose.doctor._matches import Matches as Matches
from splatseg.pose.doctor._matches import match_views as match_views
