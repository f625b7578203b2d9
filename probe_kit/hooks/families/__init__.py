"""One folder per family; `shared` holds what several use, `embedded` writes the checkpoints of the package.

A folder has these files, of which it needs the first two:

* `__init__.py`: `FAMILIES`, the declarations. They load no torch. The docstring names the page and the reference.
* `adapter.py`: the `Model` or `Policy`: streams, taps, roles, loader.
* `network.py`: the network in torch or its construction, its sizes, and the names of its weights.
* `packing.py`: pictures, words and state as the network takes them.
* `checkpoint.py`: reading of files that only this family has.
* `outputs.py`: the quantities of a golden reference.

Its tests and the writer of its tiny checkpoint are in the folder of its name in `tests/hooks/families`.
"""
