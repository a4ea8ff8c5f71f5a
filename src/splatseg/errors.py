"""What splatseg raises. Everything it raises on purpose derives from `SplatsegError`.

    SplatsegError
    ├── InputError (ValueError)               what the caller gave cannot be used
    │   ├── ShapeError                        an array has the wrong shape
    │   ├── RangeError                        a value is outside its range, NaN or infinite
    │   ├── FileFormatError                   a file is not what it should be
    │   └── MissingFileError (FileNotFoundError)
    ├── OutputError (OSError)                 a file or folder cannot be written
    ├── MissingPackageError (ImportError)     an optional package is not installed
    └── BackendError (RuntimeError)           a backend cannot run here

Each class is also the builtin that fits, so ``except ValueError`` works. A message is one
sentence that names the argument or the file, what was expected and what came.
"""


class SplatsegError(Exception):
    """Base of every error that splatseg raises on purpose."""


class InputError(SplatsegError, ValueError):
    """What the caller gave cannot be used."""


class ShapeError(InputError):
    """An array has the wrong shape."""


class RangeError(InputError):
    """A value lies outside its range, or is NaN or infinite."""


class FileFormatError(InputError):
    """A file is not what it should be; the message starts with its path."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that was named does not exist."""


class OutputError(SplatsegError, OSError):
    """A file or folder cannot be written: the message names it and says what to do."""


class MissingPackageError(SplatsegError, ImportError):
    """An optional package is not installed; the message says how to install it."""


class BackendError(SplatsegError, RuntimeError):
    """A rendering backend cannot run here or refuses what was asked of it."""
