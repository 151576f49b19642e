"""What long work tells is heard by who watches it, parts as shares of the whole, and nothing by anybody else."""

from forcegp.progress import part, tell, watched


def test_parts_are_shares_of_the_whole_and_ends_are_ends():
    told = []
    tell(1, 2)  # to nobody
    with watched(lambda *given: told.append(given)):
        for number in range(2):
            with part(number, 2, f"part {number}, "):
                tell(1, 4, "quarter")
        with watched(None):
            tell(1, 1)
        tell(3, 3, "done")
    tell(1, 1)
    assert told == [
        (0, 2, "part 0, "), (1, 8, "part 0, quarter"), (1, 2, "part 1, "), (5, 8, "part 1, quarter"), (3, 3, "done")
    ]  # fmt: skip
