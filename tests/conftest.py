"""Strictness for every test, and a cache of compiled programs."""

import functools
import os
import pathlib

import hypothesis
import jax
import matplotlib
import pytest
from compiling import QUICK_TO_COMPILE

# Read when JAX's backend starts, here and in the processes that tests start.
for _name, _value in QUICK_TO_COMPILE.items():
    if _name not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_name}={_value}".strip()

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


@pytest.fixture(autouse=True, scope="session")
def quick_studies():
    """Studies end sooner: they draw no pictures, and play few episodes of other policies.

    The ceilings in tables and figures are means of 100 episodes, not of 20,000, and the
    pendulum's is computed on a coarse grid: compiled as in tests, the usual one takes minutes.
    """
    from rtd3jax.envs.pendulum import optimum
    from rtd3jax.study import ceilings, references
    from rtd3jax.study.derive import derive

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ceilings, "ceiling", functools.partial(ceilings.ceiling, episodes=100))
        coarse = functools.partial(optimum.mean_optimal_return, angles=80, speeds=64)
        patch.setattr(optimum, "mean_optimal_return", coarse)
        patch.setattr(references, "EPISODES", 2)
        patch.setattr(derive, "__kwdefaults__", {**derive.__kwdefaults__, "pictures": False})
        yield


@pytest.fixture
def pictures(monkeypatch):
    """Studies draw their pictures after all."""
    from rtd3jax.study.derive import derive

    monkeypatch.setattr(derive, "__kwdefaults__", {**derive.__kwdefaults__, "pictures": True})
