"""What every format must do: subclass, give `source` and `expected`, and inherit the tests."""

import shutil
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import pytest

from forcegp.errors import FileFormatError
from forcegp.recordings import Source


class SourceConformance(ABC):
    """`write` makes a log in a folder; `open` opens it; `expected` are all of its columns, or some."""

    @abstractmethod
    def write(self, folder: Path) -> Path: ...

    @abstractmethod
    def open(self, path: Path) -> Source: ...

    @abstractmethod
    def expected(self) -> dict[str, np.ndarray]: ...

    def truncated(self, path: Path) -> Path | None:
        """The file to be cut for the test of damaged files; None where half of a file is a valid one."""
        return path

    @pytest.fixture(scope="class")
    @classmethod
    def path(cls, tmp_path_factory) -> Path:
        return cls().write(tmp_path_factory.mktemp("log"))

    @pytest.fixture
    def own_path(self, path: Path, tmp_path: Path) -> Path:
        made = tmp_path / path.name
        return Path(shutil.copytree(path, made) if path.is_dir() else shutil.copy(path, made))

    @pytest.fixture(scope="class")
    @classmethod
    def source(cls, path: Path) -> Source:
        return cls().open(path)

    def read(self, source: Source, names: list[str]) -> dict[str, np.ndarray]:
        found = source.read(names)
        assert list(found) == names
        assert all(values.ndim == 1 and values.dtype in (np.float64, np.int64) for values in found.values())
        return found

    def test_columns_are_there_once(self, source):
        columns = source.columns()
        assert len(set(columns)) == len(columns)
        assert set(self.expected()) <= set(columns)

    def test_every_number_arrives(self, source):
        expected = self.expected()
        read = self.read(source, list(expected))
        for name, values in expected.items():
            np.testing.assert_array_equal(read[name], values, err_msg=name)

    def test_columns_come_in_the_order_asked_for_and_alone(self, source):
        names = list(self.expected())[::-2]
        read = self.read(source, names)
        for name in names:
            np.testing.assert_array_equal(read[name], self.expected()[name])

    def test_vectors_stand_for_columns(self, source):
        columns = set(source.columns())
        assert all(elements and set(elements) <= columns for elements in source.vectors.values())

    def test_an_unknown_column_is_refused_with_those_that_exist(self, source):
        with pytest.raises(FileFormatError, match="no column 'nonsense'"):
            source.read(["nonsense"])

    def test_files_exist(self, source):
        assert source.files()
        assert all(file.is_file() for file in source.files())

    @pytest.mark.parametrize("share", [0.3, 0.9])
    def test_half_a_file_is_refused_by_name(self, own_path, share):
        path = own_path
        file = self.truncated(path)
        if file is None:
            return
        content = file.read_bytes()
        file.write_bytes(content[: int(share * len(content))])
        with pytest.raises(FileFormatError, match=path.name.split(".")[0]):
            self.read(self.open(path), list(self.expected()))

    def test_noise_instead_of_the_file_is_refused(self, own_path):
        path = own_path
        for file in [path] if path.is_file() else [item for item in path.rglob("*") if item.is_file()]:
            file.write_bytes(np.random.default_rng(0).bytes(4096))
        with pytest.raises(FileFormatError):
            self.read(self.open(path), list(self.expected()))
