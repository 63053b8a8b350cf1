"""XLA's flags under which the tests compile: nearly all of the suite's time is compiling."""

QUICK_TO_COMPILE = {
    # Code that is not optimised takes half as long to compile, and the older way to emit the code
    # of a fusion takes half of that again.
    "--xla_backend_optimization_level": "0",
    "--xla_cpu_use_fusion_emitters": "false",
    # A module is not split into parts for threads: the workers of the tests have all cores.
    "--xla_cpu_parallel_codegen_split_count": "1",
}


def as_for_users(flags: str) -> str:
    """``flags`` of ``XLA_FLAGS`` without these: for a process whose time is not its compiling."""
    return " ".join(flag for flag in flags.split() if flag.split("=")[0] not in QUICK_TO_COMPILE)
