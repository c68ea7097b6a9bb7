"""Where jax runs: on one CPU device, on several virtual ones, or on GPUs that share the lanes.

XLA on a CPU steps MJX on little more than one core, however many there are, so MJX splits every
batch of robots over one virtual device a core (`spread`). Keys belong to lanes, so what is
computed does not depend on how many devices there are, but for the order of float sums.
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
# Robots that keep an accelerator busy; MJX steps hardly more a second with more of them.
BUSY = 4096
# Bytes that a robot takes in a program, amply: for its step XLA plans 20 kB (Humanoid), 11 (Ant).
ROBOT = 1 << 17


def configure() -> None:
    """Sets jax up for this package, before a backend starts: called on import of this module.

    Everything that computes imports it, from wherever Python has found the package.

    - one CPU device, until MJX asks for more, or as many as `GENIDM_DEVICES` says (a number
      that the user has already given to jax stands);
    - programs on a CPU run while their caller waits (`JAX_CPU_ENABLE_ASYNC_DISPATCH` overrides);
    - float32 matrix products at full precision (`JAX_DEFAULT_MATMUL_PRECISION` overrides);
    - the persistent compilation cache on, in `~/.cache/genidm/xla`
      (`JAX_COMPILATION_CACHE_DIR` overrides).
    """
    with contextlib.suppress(RuntimeError, BadInput):  # the caller has used jax: theirs stand
        if count := requested():
            _make(count)
    # A program that calls the host can wait for itself, for ever, if it runs in the background
    # (jax issue 25861); MJX on several devices steps as fast without that.
    if "JAX_CPU_ENABLE_ASYNC_DISPATCH" not in os.environ:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    if _setting("jax_default_matmul_precision") is None:
        jax.config.update("jax_default_matmul_precision", "highest")
    if _setting("jax_compilation_cache_dir") is None and (cache := _cache()):
        jax.config.update("jax_compilation_cache_dir", str(cache))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def requested() -> int | None:
    """How many CPU devices `GENIDM_DEVICES` asks for; None if it does not.

    Raises:
      BadInput: it is no number of devices. Commands say so before they begin; an import goes on
        without it.
    """
    text = os.environ.get("GENIDM_DEVICES", "").strip()
    if not text:
        return None
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 4096):
        raise BadInput(f"GENIDM_DEVICES is a number of devices from 1 to 4096, not {text!r:.40}")
    return int(text)


def _cache() -> Path | None:
    """Where compiled programs are kept; None, with a warning, where there is no home."""
    there = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        # The specification of XDG_CACHE_HOME: what is no absolute path counts as not set.
        base = there if there.is_absolute() else Path("~/.cache").expanduser()
    except RuntimeError:
        print("warning: no home directory: compiled programs are not kept", file=sys.stderr)
        return None
    return base / "genidm" / "xla"


def spread() -> None:
    """Makes one CPU device a core, unless the user has given a number; before jax is used.

    For MJX, which needs them to use more than one core.
    """
    try:
        _make(cores())
    except RuntimeError:
        if not accelerated() and jax.device_count() < cores():
            print(
                f"warning: MJX uses {jax.device_count()} of {cores()} cores, as jax was at work "
                f"before it was chosen; GENIDM_DEVICES={cores()} gives it all",
                file=sys.stderr,
            )


def _make(count: int) -> None:
    """Makes so many CPU devices; raises RuntimeError if a backend has started."""
    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    if _setting("jax_num_cpu_devices") >= 0:
        return
    # XLA has a thread a core, and a device at work holds one while it waits for others to
    # do parts of its work: with as many devices as cores 𝒢 hung on two cores, for ever.
    if count > 1:
        os.environ.setdefault("PJRT_NPROC", str(3 * count))
    jax.config.update("jax_num_cpu_devices", count)


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _setting(name: str) -> Any:
    # jax declares no types for the settings that it adds to `config` one by one.
    return getattr(jax.config, name)


def mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """The mesh whose one axis carries the lanes: all devices, unless some are named."""
    return jax.make_mesh(
        (len(devices or jax.devices()),),
        (LANES,),
        axis_types=(jax.sharding.AxisType.Auto,),
        devices=devices,
    )


def dividing(mesh: Mesh, lanes: int) -> Mesh:
    """As many devices of a mesh as share so many lanes evenly."""
    count = next(n for n in range(mesh.size, 0, -1) if lanes % n == 0)
    return mesh if count == mesh.size else Mesh(mesh.devices.flat[:count], mesh.axis_names)


def accelerated() -> bool:
    """Whether jax runs on something else than a CPU."""
    return jax.default_backend() != "cpu"


def memory() -> int | None:
    """Bytes that programs on an accelerator can have; None on a CPU, which shares the host's."""
    stats = jax.devices()[0].memory_stats()
    return stats["bytes_limit"] if stats else None


def host_memory() -> int:
    """Bytes of this machine's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def max_parallel_envs(robots: int) -> int:
    """Robots to step at once where no result depends on their number.

    On a CPU as many as asked for; on an accelerator more, which few do not keep busy, as far
    as a quarter of its memory holds them.
    """
    room = memory()
    return robots if room is None else max(robots, min(BUSY, room // 4 // ROBOT))


def pick_device(size: int) -> jax.Device:
    """Where `size` bytes can lie beside a copy of them: the first device, or the host's CPU."""
    room = memory()
    return jax.devices()[0] if room is None or 2.5 * size <= room else jax.devices("cpu")[0]


def spec(axis: int | None) -> PartitionSpec:
    """Lanes on dimension `axis`; None: a copy on every device."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, LANES)


def put(tree: Any, mesh: Mesh, axis: int | None = 0) -> Any:
    """Moves a tree of arrays onto the mesh, lanes on dimension `axis` (None: copied)."""
    return jax.device_put(tree, NamedSharding(mesh, spec(axis)))


def gather(tree: Any, mesh: Mesh) -> Any:
    """Moves a tree of arrays, wherever its parts lie, whole to the mesh's first device."""
    return jax.device_put(tree, mesh.devices.flat[0])


def over_lanes(
    f: Callable[..., Any], mesh: Mesh, inputs: Sequence[int | None], outputs: Any
) -> Callable[..., Any]:
    """`f` run by every device on its own lanes, with no talk between devices.

    Args:
      f: function of a batch of lanes.
      mesh: the devices.
      inputs: for each argument the dimension that carries the lanes, None if shared.
      outputs: the same for the output, or a tuple of it.
    """
    out = tuple(spec(o) for o in outputs) if isinstance(outputs, tuple) else spec(outputs)
    return jax.shard_map(
        f, mesh=mesh, in_specs=tuple(spec(i) for i in inputs), out_specs=out, check_vma=False
    )


configure()
