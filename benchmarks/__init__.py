"""What fingerjax can do, as figures with goals: `python -m benchmarks.NAME [--quick] [--json FILE]`.

A benchmark is a module here with a function `main(quick: bool)` that yields `Figure`s, and ends with

    if __name__ == "__main__":
        run(main)

`python -m benchmarks` runs them all. Modules whose name begins with an underscore are not benchmarks.
"""

import os

# As the program itself sets them, before NumPy is imported: see `fingerjax.__main__`.
os.environ.setdefault("NPROC", "16")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
