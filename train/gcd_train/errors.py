"""What can go wrong in the training package, and the exit code each becomes (sysexits).

    TrainError 70
    ├── RecipeError 78    a recipe file or an option is wrong
    ├── RenderError 69    no renderer can be had on this machine
    ├── DataError 66      data is missing, empty, damaged or of another kind than wanted
    ├── RunError 73       a run folder holds something that does not fit, or cannot be written
    └── Interrupted 130   the user asked to stop; the state was saved

Every message says what was wanted, what came, and what to do.
"""


class TrainError(Exception):
    """Root of all errors of this package."""

    exit_code = 70


class RecipeError(TrainError):
    """A recipe file or an option is wrong."""

    exit_code = 78


class RenderError(TrainError):
    """No renderer can be had on this machine, or it failed."""

    exit_code = 69


class DataError(TrainError):
    """Data is missing, empty, damaged or of another kind than wanted."""

    exit_code = 66


class RunError(TrainError):
    """A run folder holds something that does not fit, or cannot be written."""

    exit_code = 73


class Interrupted(TrainError):  # noqa: N818  the user's wish, not a fault
    """The user asked to stop; the state was saved."""

    exit_code = 130
