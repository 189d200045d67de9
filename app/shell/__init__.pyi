from .actions import Actions as Actions
from .actions import DeskDialogs as DeskDialogs
from .actions import StopKey as StopKey
from .actions import portable as portable
from .actions import rows_of as rows_of
from .actions import typing as typing
from .activity import ACTIVE as ACTIVE
from .activity import InspectPresenter as InspectPresenter
from .activity import busy as busy
from .activity import moving as moving
from .activity import not_set as not_set
from .activity import why_no_run as why_no_run
from .bench_link import Link as Link
from .bench_text import QuestionRow as QuestionRow
from .bench_text import model_words as model_words
from .bench_text import scene_words as scene_words
from .bench_text import words_of as words_of
from .cards import Closing as Closing
from .cards import clock as clock
from .cards import end_for_sure as end_for_sure
from .cards import note as note
from .cards import refusal_card as refusal_card
from .cards import stopped_card as stopped_card
from .cards import tell as tell
from .datasets import Opened as Opened
from .datasets import Prelabeller as Prelabeller
from .datasets import model_of as model_of
from .datasets import opener as opener
from .errors import ErrorBox as ErrorBox
from .errors import install as install
from .errors import log as log
from .errors import log_to as log_to
from .label_items import CURSOR_S as CURSOR_S
from .label_items import Edit as Edit
from .label_items import LabelItem as LabelItem
from .label_items import Prelabel as Prelabel
from .label_items import Sheets as Sheets
from .label_items import as_pair as as_pair
from .label_items import parse as parse
from .label_items import reader as reader
from .label_items import shots_of as shots_of
from .layouts import LayoutMenu as LayoutMenu
from .layouts import Layouts as Layouts
from .live import LivePage as LivePage
from .live import LivePresenter as LivePresenter
from .live import LiveViews as LiveViews
from .live import column as column
from .live import no_higher as no_higher
from .run_story import ProbeLook as ProbeLook
from .run_story import RunStory as RunStory
from .run_story import TrialStory as TrialStory
from .run_story import no_probe as no_probe
from .run_story import outlines as outlines
from .run_story import scene_of as scene_of
from .run_story import score_of as score_of
from .run_story import truth_of as truth_of
from .saving import Commits as Commits
from .saving import Intent as Intent
from .saving import Post as Post
from .saving import Saving as Saving
from .settings import WindowSettings as WindowSettings
from .settings import ignored_words as ignored_words
from .settings import load_settings as load_settings
from .settings import save_settings as save_settings
from .settings import settings_path as settings_path
from .top_bar import ChipsPresenter as ChipsPresenter
from .top_bar import ServoSwitch as ServoSwitch
from .top_bar import SpeedOverride as SpeedOverride
from .top_bar import pill_of as pill_of
from .window import USUAL as USUAL
from .window import Appearance as Appearance
from .window import MainWindow as MainWindow
from .window import pulled_back as pulled_back
from .workspace import Command as Command
from .workspace import Desk as Desk
from .workspace import Memory as Memory
from .workspace import Workspace as Workspace

__all__ = [
    "ACTIVE",
    "CURSOR_S",
    "USUAL",
    "Actions",
    "Appearance",
    "ChipsPresenter",
    "Closing",
    "Command",
    "Commits",
    "Desk",
    "DeskDialogs",
    "Edit",
    "ErrorBox",
    "InspectPresenter",
    "Intent",
    "LabelItem",
    "LayoutMenu",
    "Layouts",
    "Link",
    "LivePage",
    "LivePresenter",
    "LiveViews",
    "MainWindow",
    "Memory",
    "Opened",
    "Post",
    "Prelabel",
    "Prelabeller",
    "ProbeLook",
    "QuestionRow",
    "RunStory",
    "Saving",
    "ServoSwitch",
    "Sheets",
    "SpeedOverride",
    "StopKey",
    "TrialStory",
    "WindowSettings",
    "Workspace",
    "as_pair",
    "busy",
    "clock",
    "column",
    "end_for_sure",
    "ignored_words",
    "install",
    "load_settings",
    "log",
    "log_to",
    "model_of",
    "model_words",
    "moving",
    "no_higher",
    "no_probe",
    "not_set",
    "note",
    "opener",
    "outlines",
    "parse",
    "pill_of",
    "portable",
    "pulled_back",
    "reader",
    "refusal_card",
    "rows_of",
    "save_settings",
    "scene_of",
    "scene_words",
    "score_of",
    "settings_path",
    "shots_of",
    "stopped_card",
    "tell",
    "truth_of",
    "typing",
    "why_no_run",
    "words_of",
]
