from .collect_form import TargetButtons as TargetButtons
from .collect_form import TargetForm as TargetForm
from .collect_form import TargetPanel as TargetPanel
from .fields import FormFields as FormFields
from .fields import decimal_box as decimal_box
from .fields import field_label as field_label
from .fields import inset_spin_boxes as inset_spin_boxes
from .fields import set_entries as set_entries
from .jogging import JOINTS as JOINTS
from .jogging import JogPad as JogPad
from .jogging import JogUnit as JogUnit
from .jogging import PoseReadout as PoseReadout
from .probe import GripperPanel as GripperPanel
from .probe import LastProbePanel as LastProbePanel
from .probe import PairHealthPanel as PairHealthPanel
from .probe import ProbePanel as ProbePanel
from .probe import ProbeText as ProbeText
from .questions import ACTIVE_DURING_QUESTION as ACTIVE_DURING_QUESTION
from .questions import ChoiceBar as ChoiceBar
from .questions import NameDialog as NameDialog
from .questions import NameField as NameField
from .run_form import STRATEGIES as STRATEGIES
from .run_form import RunButtons as RunButtons
from .run_form import RunForm as RunForm
from .run_form import RunPanel as RunPanel
from .run_form import ScenePanel as ScenePanel
from .training_form import LABEL_TITLES as LABEL_TITLES
from .training_form import TrainingButtons as TrainingButtons
from .training_form import TrainingForm as TrainingForm
from .training_form import TrainingFormPanel as TrainingFormPanel

__all__ = [
    "ACTIVE_DURING_QUESTION",
    "JOINTS",
    "LABEL_TITLES",
    "STRATEGIES",
    "ChoiceBar",
    "FormFields",
    "GripperPanel",
    "JogPad",
    "JogUnit",
    "LastProbePanel",
    "NameDialog",
    "NameField",
    "PairHealthPanel",
    "PoseReadout",
    "ProbePanel",
    "ProbeText",
    "RunButtons",
    "RunForm",
    "RunPanel",
    "ScenePanel",
    "TargetButtons",
    "TargetForm",
    "TargetPanel",
    "TrainingButtons",
    "TrainingForm",
    "TrainingFormPanel",
    "decimal_box",
    "field_label",
    "inset_spin_boxes",
    "set_entries",
]
