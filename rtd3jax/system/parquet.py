"""Reads Parquet files."""

import os

import pyarrow as pa
import pyarrow.parquet as pq

from rtd3jax.errors import UserError, short_reason
from rtd3jax.system.files import user_path


def read_parquet(path: str | os.PathLike) -> pa.Table:
    """The table of a Parquet file.

    Raises:
        UserError: when the file is missing, damaged, or of another kind.
    """
    try:
        # By a handle, because PyArrow does not take a path whose bytes are not text.
        with user_path(path).open("rb") as file:
            return pq.ParquetFile(file, page_checksum_verification=True).read()
    except OSError as error:
        reason = error.strerror or short_reason(error)
        raise UserError(f"{path} cannot be read ({reason})") from error
    except (pa.ArrowException, ValueError) as error:
        raise UserError(
            f"{path} cannot be read as a Parquet file ({short_reason(error)})"
        ) from error
