"""Rows of a Dataset by index."""

import numpy as np
import pytest
from tests.data.samples import assert_equal, complete, dataset


@pytest.mark.parametrize("index", [slice(10, 20), [3, 1], np.arange(40) % 2 == 0, np.array([5, 7])])
def test_rows_by_index(index):
    data = complete()
    assert_equal(data[index], data.rows(index))
    with pytest.raises(TypeError, match="not iterable"):
        list(dataset())
