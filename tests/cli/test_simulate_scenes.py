"""`forcegp simulate` with other friction, surfaces and contacts."""


def test_options_of_other_scenarios_are_refused(forcegp, tmp_path):
    for words, message in (
        (("quadruped", "--surface", "tilted"), "--surface means nothing to quadruped"),
        (("quadruped", "--joint-friction", "lugre"), "lugre"),
    ):
        forcegp("simulate", *words, "--out", "no.h5", folder=tmp_path).refused(message)
