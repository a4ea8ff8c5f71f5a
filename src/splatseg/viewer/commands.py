"""Commands of a session, and the values that they are made of.

session.do(commands.Rename(3, "red mug"))
"""

from splatseg.viewer._document import Accept as Accept
from splatseg.viewer._document import Apply as Apply
from splatseg.viewer._document import Delete as Delete
from splatseg.viewer._document import Document as Document
from splatseg.viewer._document import Edit as Edit
from splatseg.viewer._document import Isolate as Isolate
from splatseg.viewer._document import Join as Join
from splatseg.viewer._document import Keep as Keep
from splatseg.viewer._document import Mask as Mask
from splatseg.viewer._document import Object as Object
from splatseg.viewer._document import Refine as Refine
from splatseg.viewer._document import Reject as Reject
from splatseg.viewer._document import Rename as Rename
from splatseg.viewer._document import Select as Select
from splatseg.viewer._document import SetClass as SetClass
from splatseg.viewer._document import SetColour as SetColour
from splatseg.viewer._document import SetLocked as SetLocked
from splatseg.viewer._document import SetVisible as SetVisible
from splatseg.viewer._document import Split as Split
from splatseg.viewer._document import Subtract as Subtract
from splatseg.viewer._document import Suggest as Suggest
from splatseg.viewer._document import Suggestion as Suggestion
