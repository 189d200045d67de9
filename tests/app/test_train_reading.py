"""What the Train page says of a dataset that nobody has labelled yet."""

from dataclasses import replace

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.app.train.reading import TrainingReader
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.bench.assembly import model_in_use
from touchdown.backend.learning.registry import SHIPPED_MODEL, ModelRegistry
from touchdown.widgets.forms.training_form import TrainingForm


def test_labels_that_would_count_are_named_with_the_way_to_them(tmp_path):
    reading = TrainingReader(ModelRegistry(tmp_path / "models"))
    form = replace(TrainingForm(), data=str(tmp_path / "data"), labels="approved")

    def told(labels="approved"):
        return reading.look(replace(form, labels=labels), anew=True).trouble

    with Dataset.open(tmp_path / "data", person="ann") as dataset:
        assert told() == (
            "No label counts yet: accept labels in Label (Ctrl+2) and let somebody else approve "
            "them."
        )
        context = context_for(dataset)
        uuids = [
            dataset.record(
                small_episode(), Label(k, 0, 0, 9), source="measured", context=context
            ).uuid
            for k in range(3)
        ]
        assert told().startswith(
            "No label counts yet. Labels 'All, with drafts' would give 3 episodes. Or"
        )
        assert told("drafts") == ""
        dataset.labels.accept("ann", uuids[0])
        assert "Labels 'Approved and submitted' would give 1 episode." in told()
        dataset.labels.approve("bob", uuids[0])
        assert told() == ""


def test_a_promoted_model_can_be_rolled_back_without_data(tmp_path):
    registry = ModelRegistry(tmp_path / "models")
    reading, form = TrainingReader(registry), replace(TrainingForm(), data=str(tmp_path / "none"))
    assert reading.look(form, anew=True).in_use is None
    registry.promote(model_in_use("pot", None))
    looked = reading.look(form, anew=True)
    assert looked.trouble
    assert looked.in_use is not None
    assert (looked.in_use.piece, looked.in_use.before) == ("pot", SHIPPED_MODEL)
