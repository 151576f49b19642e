"""Finished cells, without processes of their own."""

from forcegp.experiments.results import write_json

DATA = "data/seed1"


def keep(results, name, spec, result, write=lambda folder: None):
    """Store a cell; `write(folder)` puts its files."""
    with results.writing(name) as folder:
        write(folder)
        write_json(folder / "cell.json", {"digest": name, "spec": spec, "result": result})
