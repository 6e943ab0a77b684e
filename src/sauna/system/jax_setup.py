"""How JAX is set up in a process, before it is imported for the first time."""

from __future__ import annotations

import os
import sys

from sauna.system.errors import BadInput

# What a worker's JAX on the CPU has to know before it is imported.
ONE_THREAD = dict.fromkeys(("PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
ON_CPU = {**ONE_THREAD, "JAX_PLATFORMS": "cpu"}


def configure_jax(simulated: int = 0, device: str = "cpu") -> None:
    """One CPU thread per process, synchronous dispatch, and a compilation cache on disk.

    With one thread the bits of a result do not depend on the number of cores; the small programs
    here run faster, too. A process that already used JAX keeps its own thread count.

    Args:
      simulated: on a CPU, into how many devices it is divided; 0: it is one.
      device: cpu or gpu.
    """
    platform = os.environ.get("JAX_PLATFORMS") or {"cpu": "cpu", "gpu": "cuda"}[device]
    if platform == "cpu":
        os.environ.setdefault("PJRT_NPROC", "1")
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of SciPy's, which Numba calls
    else:  # others may share it: memory is taken as it is needed, not three quarters at once
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    ours = "jax" not in sys.modules  # else the process has chosen
    import jax

    if ours:  # not in os.environ, which a later run of this process reads
        jax.config.update("jax_platforms", platform)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if simulated > 1 and platform == "cpu":
        jax.config.update("jax_num_cpu_devices", simulated)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        jax.config.update("jax_compilation_cache_dir", os.path.join(base, "sauna", "jax"))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def check_platform(device: str) -> None:
    """Refuses to go on where JAX was set up for another device in this process.

    Raises:
      BadInput: naming both.
    """
    import jax

    found = jax.devices()[0].platform
    if found != device:
        raise BadInput(f"device: JAX uses the {found} here, not the {device}")
