"""The devices of jax: one CPU device, several virtual CPU devices, or GPUs that share the lanes.

On a CPU, one XLA device steps MJX on little more than one core, so MJX distributes every batch of
robots over one virtual device per core (`spread`). Each lane has its own key, so results do not
depend on the number of devices, except for the order of float sums.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from genidm.errors import BadInput

LANES = "lanes"
# Robots that keep an accelerator busy; with more, MJX makes hardly more steps per second.
BUSY = 4096
# Upper bound of a robot's bytes in a program: XLA plans 20 kB (Humanoid) or 11 kB (Ant) per step.
ROBOT = 1 << 17


def configure() -> None:
    """Configures jax for this package; runs on import of this module, before a backend starts.

    Every module that computes imports this module.

    - CPU devices: `GENIDM_DEVICES`, else one until MJX calls `spread` (a number that the user
      has already given to jax has priority);
    - programs on a CPU block their caller (`JAX_CPU_ENABLE_ASYNC_DISPATCH` overrides);
    - float32 matrix products at full precision (`JAX_DEFAULT_MATMUL_PRECISION` overrides);
    - the persistent compilation cache is in `~/.cache/genidm/xla`
      (`JAX_COMPILATION_CACHE_DIR` overrides).
    """
    # RuntimeError: the caller has started a backend, whose number of devices is then fixed.
    with contextlib.suppress(RuntimeError, BadInput):
        if count := requested():
            _make(count)
    # With asynchronous dispatch a program that calls the host can deadlock (jax issue 25861);
    # without it MJX on several devices is as fast.
    if "JAX_CPU_ENABLE_ASYNC_DISPATCH" not in os.environ:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    if _setting("jax_default_matmul_precision") is None:
        jax.config.update("jax_default_matmul_precision", "highest")
    if _setting("jax_compilation_cache_dir") is None and (cache := _cache()):
        jax.config.update("jax_compilation_cache_dir", str(cache))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def requested() -> int | None:
    """The number of CPU devices in `GENIDM_DEVICES`; None if it is not set.

    Raises:
      BadInput: it is not a number from 1 to 4096. Commands report this at their start; the import
        of this module ignores it.
    """
    text = os.environ.get("GENIDM_DEVICES", "").strip()
    if not text:
        return None
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 4096):
        raise BadInput(f"GENIDM_DEVICES must be a number from 1 to 4096, not {text!r:.40}")
    return int(text)


def _cache() -> Path | None:
    """Directory of compiled programs; None, with a warning, without a home directory."""
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        # The specification of XDG_CACHE_HOME: a relative path is ignored.
        base = given if given.is_absolute() else Path("~/.cache").expanduser()
    except RuntimeError:
        print("warning: no home directory: compiled programs are not kept", file=sys.stderr)
        return None
    return base / "genidm" / "xla"


def spread() -> None:
    """Makes one CPU device per core, so that MJX uses all cores; a number by the user has priority.

    Prints a warning if a jax backend has started already, because it is then too late.
    """
    try:
        _make(cores())
    except RuntimeError:
        if not accelerated() and jax.device_count() < cores():
            print(
                f"warning: MJX uses {jax.device_count()} of {cores()} cores, because jax started "
                f"before MJX was chosen; set GENIDM_DEVICES={cores()} to use all",
                file=sys.stderr,
            )


def _make(count: int) -> None:
    """Makes `count` CPU devices, unless the user has set a number.

    Raises:
      RuntimeError: a backend has started.
    """
    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    if _setting("jax_num_cpu_devices") >= 0:
        return
    # XLA has one thread per core, and each device blocks a thread while it waits for other
    # threads to do parts of its work: with two devices on two cores 𝒢 deadlocked.
    if count > 1:
        os.environ.setdefault("PJRT_NPROC", str(3 * count))
    jax.config.update("jax_num_cpu_devices", count)


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _setting(name: str) -> Any:
    # jax declares no types for the settings that it adds to `config` one by one.
    return getattr(jax.config, name)


def mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh whose one axis carries the lanes; default: all devices."""
    return jax.make_mesh(
        (len(devices or jax.devices()),),
        (LANES,),
        axis_types=(jax.sharding.AxisType.Auto,),
        devices=devices,
    )


def dividing(mesh: Mesh, lanes: int) -> Mesh:
    """The largest part of a mesh whose devices share the lanes evenly."""
    count = next(n for n in range(mesh.size, 0, -1) if lanes % n == 0)
    return mesh if count == mesh.size else Mesh(mesh.devices.flat[:count], mesh.axis_names)


def accelerated() -> bool:
    """Whether jax runs on an accelerator."""
    return jax.default_backend() != "cpu"


def memory() -> int | None:
    """Bytes of memory for programs on an accelerator; None on a CPU, which uses the host's."""
    stats = jax.devices()[0].memory_stats()
    return stats["bytes_limit"] if stats else None


def host_memory() -> int:
    """Bytes of this machine's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def max_parallel_envs(robots: int) -> int:
    """Largest batch to step together for a caller that asks for `robots`.

    For callers whose results do not depend on the number. On a CPU it is `robots`. An accelerator
    gets more, up to a quarter of its memory, because small batches leave it idle.
    """
    room = memory()
    return robots if room is None else max(robots, min(BUSY, room // 4 // ROBOT))


def pick_device(size: int) -> jax.Device:
    """The first device if its memory holds `size` bytes and a copy of them, else the host's CPU."""
    room = memory()
    return jax.devices()[0] if room is None or 2.5 * size <= room else jax.devices("cpu")[0]


def spec(axis: int | None) -> PartitionSpec:
    """The sharding with lanes on dimension `axis`; None: a copy on every device."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, LANES)


def put(tree: Any, mesh: Mesh, axis: int | None = 0) -> Any:
    """Distributes a tree of arrays over the mesh, by lanes on dimension `axis` (None: copies)."""
    return jax.device_put(tree, NamedSharding(mesh, spec(axis)))


def gather(tree: Any, mesh: Mesh) -> Any:
    """Moves a tree of arrays, whole, to the first device of the mesh."""
    return jax.device_put(tree, mesh.devices.flat[0])


def over_lanes(
    f: Callable[..., Any], mesh: Mesh, inputs: Sequence[int | None], outputs: Any
) -> Callable[..., Any]:
    """Maps `f` over the devices: each runs it on its own lanes, without communication.

    Args:
      f: function of a batch of lanes.
      mesh: the devices.
      inputs: for each argument, the dimension that carries the lanes; None: copied to all devices.
      outputs: the same for the output, or a tuple for several outputs.
    """
    out = tuple(spec(o) for o in outputs) if isinstance(outputs, tuple) else spec(outputs)
    return jax.shard_map(
        f, mesh=mesh, in_specs=tuple(spec(i) for i in inputs), out_specs=out, check_vma=False
    )


configure()
