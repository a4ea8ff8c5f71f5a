from . import commands as commands
from ._notebook import view as view
from ._session import Session as Session
from ._session import open_session as open_session
