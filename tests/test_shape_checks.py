"""`FORCEGP_CHECK_SHAPES=1`, which `make test-all` sets, makes a wrong shape in a signature an error."""

import os
import subprocess
import sys


def test_a_wrong_shape_is_refused_where_that_was_asked_for(repository):
    code = (
        "import tests.conftest, torch; from jaxtyping import TypeCheckError\n"
        "from forcegp.mechanics.surfaces import surface_axes\n"
        "try: surface_axes(torch.ones(4, dtype=torch.float64))\n"
        "except TypeCheckError as error: print('surface_axes' in str(error))\n"
    )
    paths = os.pathsep.join([str(repository), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "FORCEGP_CHECK_SHAPES": "1", "PYTHONPATH": paths}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr
