"""Finished jobs, without processes of their own."""

from forcegp.atomic_files import atomic_folder, write_json

DATA = "data/seed1"


def keep(results, name, spec, result, write=lambda folder: None):
    """Store a job; `write(folder)` puts its files."""
    with atomic_folder(results.place(name)) as folder:
        folder.mkdir()
        write(folder)
        write_json(folder / "job.json", {"digest": name, "code": "", "spec": spec, "result": result})
