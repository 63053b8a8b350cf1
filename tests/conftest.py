"""Strictness for every test, and a cache of compiled programs."""

import pathlib

import hypothesis
import jax
import matplotlib

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
