"""Tests random configurations and command lines: each runs, or is refused with a one-line error.

Usage: python experiments/reliability/fuzz.py [--cases N] [--quick]

Half of the cases make a `Config` from arbitrary Python values. The others are command lines of the
sweep, with values that are valid, at a limit, impossible, or not numbers. An accepted command line
is planned (`--dry-run`) and then trained for a few steps. If a case raises an error other than
`UserError`, or prints more than one line of error, hypothesis prints its smallest form, and the
exit status is 1.
"""

import argparse
import collections
import contextlib
import dataclasses
import io
import sys
import tempfile
import warnings
from unittest import mock

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

import rtd3jax as rtd
from rtd3jax import sweep
from rtd3jax.study import derive, finish, references

FIELDS = [field.name for field in dataclasses.fields(rtd.Config)]
VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-2, 5_000),
    st.integers(),
    st.floats(),
    st.floats(0, 1),
    st.text(max_size=8),
    st.sampled_from([*rtd.ALGORITHMS, "1e-3", b"x", (), [1], 1 + 0j, float]),
)

# Fields that determine shapes have few valid values, so that few programs are compiled.
SHAPES = {
    "--env": ["rover", "pendulum"],
    "--algorithms": list(rtd.ALGORITHMS),
    "--history-lengths": ["1", "2"],
    "--total-steps": ["24"],
    "--hidden-size": ["4"],
    "--batch-size": ["4"],
    "--learning-starts": ["8"],
    "--eval-every": ["12"],
    "--eval-episodes": ["1"],
    "--final-episodes": ["1"],
    "--seeds": ["1"],
}
NUMBERS = [
    f"--{name.replace('_', '-')}"
    for name in (f.name for f in dataclasses.fields(rtd.Config) if f.metadata.get("traced"))
]
OTHERS = {
    "--disturbances": ["none"],
    "--policy-delay": ["2"],
    "--update-every": ["3", "0"],
    "--checkpoint-every": ["5m", "3steps", "1s", "0s", "5x", "-1", "99999999999h", ""],
    "--shard": ["1/1", "1/2", "2/2", "3/2", "0/0", "a/b", "1/99999999"],
    "--strategy": ["map", "nap"],
    "--device": ["cpu", "gpu", "abacus"],
    "--preset": ["quack"],
    "--no-such-flag": ["1"],
}
SMALL = st.floats(0, 1).map(str)
ODD = st.one_of(
    st.sampled_from(
        ["", " ", "-1", "0", "nan", "inf", "-inf", "1e400", "1.5", "True", "None", "é", "1_0"]
    ),
    st.integers().map(str),
    st.floats().map(str),
    st.text(max_size=6).filter(lambda text: "\x00" not in text),
)


@st.composite
def command_lines(draw, shapes):
    """Valid values for every flag, some of which are replaced or extended."""
    flags = {flag: draw(st.sampled_from(values)) for flag, values in shapes.items()}
    for flag in draw(st.lists(st.sampled_from(NUMBERS), max_size=3)):
        flags[flag] = draw(st.one_of(SMALL, SMALL, ODD))
    if draw(st.integers(0, 2)) == 0:
        for flag in draw(st.lists(st.sampled_from(sorted(OTHERS)), max_size=2)):
            flags[flag] = draw(st.sampled_from(OTHERS[flag]))
    if draw(st.integers(0, 3)) == 0:
        for flag in draw(st.lists(st.sampled_from([*SHAPES, *OTHERS]), min_size=1, max_size=2)):
            flags[flag] = draw(ODD)
    return [f"{flag}={value}" for flag, value in flags.items()]


def call(arguments):
    """The exit status and the two outputs of the command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = sweep.main(arguments)
    return status, out.getvalue(), err.getvalue()


def check_config(fields, counts):
    try:
        config = rtd.Config(**fields)
    except rtd.UserError as error:
        assert str(error) and "\n" not in str(error), str(error)
        counts["configurations refused"] += 1
    else:
        assert rtd.Config(**config.to_dict()) == config
        counts["configurations accepted"] += 1


def check_command(arguments, counts, root):
    status, out, err = call([*arguments, "--dry-run"])
    if status == 2:
        assert err.startswith("error: ") and err.count("\n") == 1, err
        counts["command lines refused"] += 1
        return
    assert status == 0 and "programs to compile" in out, (status, out, err)
    with tempfile.TemporaryDirectory(dir=root) as name:
        status, out, err = call([*arguments, "--quiet", f"--out={name}/run"])
    if status == 2:  # an error that the plan does not find: a shard, a device
        assert err.startswith("error: ") and err.count("\n") == 1, err
        counts["command lines refused"] += 1
    else:
        assert status in (0, 1) and "Traceback" not in err, (status, err)
        assert "failed:" not in err, err  # numbers may lose a lane, but must not raise an error
        counts["command lines run" if status == 0 else "command lines run, lane lost"] += 1


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=5_000)
    parser.add_argument("--quick", action="store_true", help="few cases, one program")
    options = parser.parse_args(arguments)
    cases, shapes = options.cases, SHAPES
    if options.quick:
        cases, shapes = 240, {flag: values[:1] for flag, values in SHAPES.items()}
    counts: collections.Counter[str] = collections.Counter()
    checks = settings(
        max_examples=cases // 2,
        deadline=None,
        database=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    with (
        tempfile.TemporaryDirectory() as root,
        warnings.catch_warnings(),
        mock.patch.object(references, "EPISODES", 1),
        mock.patch.object(derive, "learning_curves"),  # each figure takes seconds
        mock.patch.object(derive, "final_returns"),
        mock.patch.object(finish, "refresh_page"),
    ):
        warnings.simplefilter("ignore")
        fields = st.dictionaries(st.sampled_from(FIELDS), VALUES, max_size=4)
        seed(0)(checks(given(fields)(lambda f: check_config(f, counts))))()
        lines = command_lines(shapes)
        seed(0)(checks(given(lines)(lambda a: check_command(a, counts, root))))()
    for name, count in sorted(counts.items()):
        print(f"{count:6,} {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
