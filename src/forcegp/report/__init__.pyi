from .motion import (
    Arrows as Arrows, RecordedScene as RecordedScene, recorded_scene as recorded_scene, recording as recording,
)
from .page import (
    Page as Page, write_page as write_page, model_page as model_page, scene_notes as scene_notes,
    scores_sentence as scores_sentence, scores_table as scores_table,
)
