"""Build: the Cython kernels of `cython/`, and `drivers/` installed as `robotd.drivers`."""

import os
from pathlib import Path

from setuptools import Extension, setup

PACKAGES = [
    "robotd",
    "robotd.drivers",
    "robotd.ctl",
    "robotd.geometry",
    "robotd.operations",
    "robotd.identify",
    "robotd.roof",
    "robotd.roomba",
    "robotd.server",
    "robotd.sim",
    "robotd.solver",
    "robotd.vision",
    "robotd.workbench",
]

# cython/<file>.pyx -> module; each has a numpy reference beside it, which runs when this build is skipped
KERNELS = {
    "stroke": "robotd.vision._stroke",
    "cluster": "robotd.vision._cluster",
    "polyline": "robotd.vision._polyline",
    "join": "robotd.vision._join",
    "measure": "robotd.vision._measure",
    "blink": "robotd.vision._blink",
    "sensor": "robotd.sim._sensor",
    "bundle": "robotd.solver._bundle",
    "rays": "robotd.solver._rays",
    "throughput": "robotd.identify._throughput",
    "json_keys": "robotd._json_keys",
    "sightings": "robotd._sightings",
}


def kernels() -> list[Extension]:
    if os.environ.get("ROBOTD_NO_EXTENSIONS") == "1":
        return []
    import numpy
    from Cython.Build import cythonize

    extensions = [
        Extension(
            module,
            [f"cython/{name}.pyx"],
            include_dirs=[numpy.get_include()],
            define_macros=[("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")],
            extra_compile_args=["-O3", "-fno-math-errno", "-fno-trapping-math", "-ftree-vectorize"],
        )
        for name, module in KERNELS.items()
        if Path(f"cython/{name}.pyx").exists()
    ]
    return cythonize(
        extensions,
        build_dir="build/cython",
        compiler_directives={
            "language_level": 3,
            "boundscheck": False,
            "wraparound": False,
            "cdivision": True,
            "initializedcheck": False,
        },
    )


setup(
    packages=PACKAGES,
    package_dir={"robotd.drivers": "drivers"},
    package_data={"robotd": ["py.typed", "*.pyi", "*/*.pyi", "*/*.html"]},
    data_files=[
        ("share/robotd/etc", ["etc/robotd.toml", "etc/roof.toml", "etc/60-robotd.rules"]),
        ("share/robotd/etc/stores", sorted(str(path) for path in Path("etc/stores").glob("*.toml"))),
        ("share/robotd/systemd", sorted(str(path) for path in Path("systemd").iterdir())),
    ],
    ext_modules=kernels(),
    options={"build_ext": {"parallel": os.cpu_count() or 1}},
)
