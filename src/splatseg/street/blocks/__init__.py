"""Long drives in overlapping blocks: cut, fitted and labelled one by one, joined without a seam."""

from splatseg.street.blocks.cut import Drive as Drive
from splatseg.street.blocks.cut import DriveBlock as DriveBlock
from splatseg.street.blocks.cut import DriveBlockOptions as DriveBlockOptions
from splatseg.street.blocks.cut import cut_drive as cut_drive
from splatseg.street.blocks.field import DriveField as DriveField
from splatseg.street.blocks.field import ScanLabeller as ScanLabeller
from splatseg.street.blocks.files import block_file as block_file
from splatseg.street.blocks.files import build_blocks as build_blocks
from splatseg.street.blocks.files import drive_about as drive_about
from splatseg.street.blocks.files import goes_on as goes_on
from splatseg.street.blocks.files import load_drive as load_drive
from splatseg.street.blocks.files import missing_blocks as missing_blocks
from splatseg.street.blocks.files import open_blocks as open_blocks
from splatseg.street.blocks.files import save_drive as save_drive
from splatseg.street.blocks.order import frame_centres as frame_centres
from splatseg.street.blocks.parts import DriveScans as DriveScans
from splatseg.street.blocks.parts import block_capture as block_capture
from splatseg.street.blocks.parts import block_views as block_views
