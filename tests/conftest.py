"""Strictness for every test, and a cache of compiled programs."""

import os
import pathlib

import hypothesis
import jax
import matplotlib

# Read when JAX's backend starts, here and in the processes that tests start: nearly all of the
# suite's time is compiling, and code that is not optimised takes half as long to compile.
_LEVEL = "--xla_backend_optimization_level"
if _LEVEL not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_LEVEL}=0".strip()

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
cache = pathlib.Path(__file__).parent.parent / ".pytest_cache" / "jax"
jax.config.update("jax_compilation_cache_dir", str(cache))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

hypothesis.settings.register_profile(
    "rtd3jax", deadline=None, derandomize=True, max_examples=25, database=None
)
hypothesis.settings.load_profile("rtd3jax")

matplotlib.use("Agg")
