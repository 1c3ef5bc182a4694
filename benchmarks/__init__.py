"""How fast raytransfer is, beside other packages: `make bench`.

Each module ``bench_*`` has a function ``run() -> list[Result]`` and is found by its name.
"""
