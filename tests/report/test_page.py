"""The page: self-contained, small, escaped, and what cannot be drawn is named on it."""

import base64
import io
import re

import pytest
from PIL import Image

from forcegp import score
from forcegp.atomic_files import is_marked
from forcegp.errors import InvalidInput
from forcegp.report import Page, model_page, scores_sentence, write_page
from forcegp.scores.figures.model import PICTURES


def test_a_page_needs_no_network_is_small_and_shows_everything(page, tmp_path):
    write_page(tmp_path / "report.html", page)
    text = (tmp_path / "report.html").read_text()
    assert len(text.encode()) < 5e6
    own, player = text.replace(page.scene, ""), page.scene
    assert not re.findall(r'(?:src|href)="(?!data:)[^"]*"', own.split("srcdoc")[0] + own.split("</iframe>")[1])
    assert not re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="https?:', player)
    assert page.best in text
    pictures = re.findall(r'<img src="data:image/png;base64,([^"]+)"', text)
    assert len(pictures) == len(page.pictures) == 1  # friction curves
    for picture in pictures:
        assert Image.open(io.BytesIO(base64.b64decode(picture))).width > 500
    ((_, _, rows),) = page.tables
    for cell in (cell for row in rows for cell in row):
        assert f"<td>{cell}</td>" in text
    assert any("Arrows are forces" in note for note in page.scene_notes)


def test_text_is_escaped(tmp_path):
    evil = "<script>alert(1)</script>"
    page = Page(evil, evil, [(evil, evil)], tables=[(evil, [evil], [[evil]])], details={"x": evil})
    write_page(tmp_path / "report.html", page)
    text = (tmp_path / "report.html").read_text()
    assert "<script>" not in text
    assert text.count("&lt;script&gt;") == 9


def test_own_pages_are_recognised_and_kept(page, tmp_path):
    path = tmp_path / "report.html"
    write_page(path, Page("t", "b"))
    assert is_marked(path)
    with pytest.raises(InvalidInput, match="exists already"):
        write_page(path, Page("t", "other"), overwrite=False)
    assert "other" not in path.read_text()
    (tmp_path / "mine.html").write_text("<html>mine</html>")
    assert not is_marked(tmp_path / "mine.html")


def test_what_cannot_be_drawn_is_named(swinging, friction, monkeypatch):
    def refused(posterior, dataset):
        raise InvalidInput("the log is too short.")

    monkeypatch.setitem(PICTURES, "prediction", (refused, "none"))
    page = model_page(friction, swinging, title="t", best="b")
    assert len(page.pictures) == 1
    assert "prediction: not drawn, because the log is too short." in page.scene_notes


def test_the_sentence_is_true(swinging, friction):
    scores = score(friction, swinging, horizons=())
    sentence = scores_sentence(scores)
    assert f"is {scores.value('mae'):.3g} rad/s²" in sentence
    assert f"a factor {scores.value('known_physics_mae') / scores.value('mae'):.3g} less" in sentence
