"""CPU seconds in which kernels of a GPU are traced, lowered and compiled, on a machine that has none.

    JAX_PLATFORMS=cpu PYTHONPATH=. python benchmarks/gpu_compile.py ROBOT.urdf [--only WORD ...] [--samples N]

Needs `jax-cuda13-plugin` and `jax-cuda13-pjrt` of this JAX's version and `ptxas`, but none of CUDA's libraries.
The program is made for an H100 that is told to XLA; `perf record` beside it says where the seconds go.
"""

from __future__ import annotations

import argparse
import logging
import os
import time
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

CARD = "NVIDIA H100 80GB HBM3"
TARGET = f"""
gpu_device_info {{ threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
  shared_memory_per_core: 233472 threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535 memory_bandwidth: 3352320000000
  l2_cache_size: 52428800 clock_rate_ghz: 1.98 device_memory_size: 84942979072 shared_memory_per_block_optin: 232448
  cuda_compute_capability {{ major: 9 feature_extension: ACCELERATED_FEATURES }} registers_per_core_limit: 65536
  registers_per_block_limit: 65536 thread_dim_limit_x: 1024 thread_dim_limit_y: 1024 thread_dim_limit_z: 64
  device_vendor: "NVIDIA Corporation" platform_version: "Compute Capability 9.0a" device_address_bits: 64
  name: "{CARD}" driver_version: "13.0.0" runtime_version: "13.0.0" compile_time_toolkit_version: "13.0.0" }}
platform_name: "CUDA" dnn_version_info {{ major: 9 minor: 12 patch: 0 }} device_description_str: "{CARD}"
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", type=Path, metavar="ROBOT.urdf")
    parser.add_argument("--only", nargs="+", default=[""], help="words that the kernels' names hold")
    parser.add_argument("--samples", type=int, default=1 << 19)
    options = parser.parse_args()
    os.environ["JAX_SKIP_CUDA_CONSTRAINTS_CHECK"] = "1"
    logging.disable(logging.CRITICAL)  # that CUDA's libraries are missing
    import jax
    from jax._src import xla_bridge
    from jax.experimental import topologies

    jax.config.update("jax_enable_x64", True)
    xla_bridge.discover_pjrt_plugins()
    card = topologies.get_topology_desc("card", "cuda", topology="1x1x1", target_config=TARGET).devices[0]
    _told_to_pallas()
    place = jax.sharding.SingleDeviceSharding(card)
    for name, function, widths in _kernels(options.robot):
        if any(word in name for word in options.only):
            given = [jax.ShapeDtypeStruct((options.samples, k), float, sharding=place) for k in widths]
            marks = [time.process_time()]
            traced = jax.jit(function).trace(*given)
            marks.append(time.process_time())
            lowered = traced.lower()
            marks.append(time.process_time())
            lowered.compile()
            marks.append(time.process_time())
            trace, lower, compiled = (b - a for a, b in zip(marks, marks[1:], strict=False))
            print(f"{name:22} traced {trace:6.2f}, lowered {lower:6.2f}, compiled {compiled:6.2f} CPU s", flush=True)


def _told_to_pallas() -> None:
    """Which card its kernels are for: it would ask the first device."""
    import jax
    from jax._src.mesh import AbstractDevice

    registration: Any = import_module("jax._src.pallas.triton.pallas_call_registration")
    device = AbstractDevice(device_kind=CARD, num_cores=132, platform="cuda")
    mesh = jax.sharding.AbstractMesh((1,), ("x",), abstract_device=device)
    asked = registration.gpu_info_lib.get_gpu_info

    def told() -> Any:
        with jax.sharding.use_abstract_mesh(mesh):
            return asked()

    registration.gpu_info_lib.get_gpu_info = told


def _kernels(robot: Path) -> list[tuple[str, Any, list[int]]]:
    """Name, function of arrays, and columns of each array."""
    import figaroh_jax as fj
    from figaroh_jax.compiled.kernels import _kernel, known_codes
    from figaroh_jax.rigid import dynamics, normal_equations, regressor
    from figaroh_jax.rigid.regrouped import kept_columns

    model = fj.load_urdf(robot)
    three = [model.nq, model.nv, model.nv]
    kept = kept_columns(model.joints, known_codes(normal_equations._row_form(0, None), model))
    rows = normal_equations._row_form(1, kept, normal_equations.TOGETHER)
    forms = [
        ("rows of a normal matrix", rows, [*three, model.nv, model.nv]),
        ("inverse dynamics", dynamics._TORQUES, three),
        ("packed regressor", regressor._PACKED, three),
        ("mass matrix", dynamics._MASSES, three[:1]),
    ]
    return [(name, partial(_kernel, form, known_codes(form, model), model), widths) for name, form, widths in forms]


if __name__ == "__main__":
    main()
