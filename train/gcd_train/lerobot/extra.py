"""The packages of the extra `lerobot`, imported when they are needed."""

from typing import Any

from gcd_train.errors import DataError

_INSTALL = "LeRobot data sets need the extra `lerobot`: pip install 'gcd-node[lerobot]'"


def load_arrow() -> tuple[Any, Any]:
    """pyarrow and pyarrow.parquet. Raises DataError if they are not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise DataError(f"{_INSTALL} (pyarrow is missing)") from error
    return pyarrow, pyarrow.parquet


def load_av() -> Any:
    """PyAV. Raises DataError if it is not installed."""
    try:
        import av
    except ImportError as error:
        raise DataError(f"{_INSTALL} (av is missing)") from error
    return av
