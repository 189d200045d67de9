from .actions import ActionRegistry as ActionRegistry
from .actions import CommandDialogs as CommandDialogs
from .actions import StopKeyFilter as StopKeyFilter
from .actions import is_typing as is_typing
from .actions import key_bindings as key_bindings
from .actions import portable_key as portable_key
from .activity import ACTIVE_STATES as ACTIVE_STATES
from .activity import DeviceInspectorPresenter as DeviceInspectorPresenter
from .activity import arm_of as arm_of
from .activity import arm_position_mm as arm_position_mm
from .activity import gripper_of as gripper_of
from .activity import is_run_active as is_run_active
from .activity import may_be_moving as may_be_moving
from .activity import missing_scene_reason as missing_scene_reason
from .activity import pause_or_resume as pause_or_resume
from .activity import start_obstacle as start_obstacle
from .bench_text import bench_caption as bench_caption
from .bench_text import count_noun as count_noun
from .bench_text import duration_text as duration_text
from .bench_text import piece_titles as piece_titles
from .bench_text import run_model_caption as run_model_caption
from .bench_text import scene_model_caption as scene_model_caption
from .cards import LIFT as LIFT
from .cards import LIFT_MM as LIFT_MM
from .cards import CloseConfirmation as CloseConfirmation
from .cards import PersonCalls as PersonCalls
from .cards import carry_out as carry_out
from .cards import error_card as error_card
from .cards import exit_after_timeout as exit_after_timeout
from .cards import is_pressing as is_pressing
from .cards import lift_hand as lift_hand
from .cards import log_event as log_event
from .cards import show_event as show_event
from .cards import stopped_card as stopped_card
from .cards import time_of_day as time_of_day
from .datasets import ModelPrelabeller as ModelPrelabeller
from .datasets import OpenedDataset as OpenedDataset
from .datasets import model_path_in_use as model_path_in_use
from .datasets import open_dataset as open_dataset
from .errors import ErrorBox as ErrorBox
from .errors import install_error_hooks as install_error_hooks
from .errors import log as log
from .errors import log_to as log_to
from .label_items import CURSOR_S as CURSOR_S
from .label_items import LabelDraft as LabelDraft
from .label_items import LabelItem as LabelItem
from .label_items import LabelSheets as LabelSheets
from .label_items import PrelabelFunction as PrelabelFunction
from .label_items import as_float_pair as as_float_pair
from .label_items import item_reader as item_reader
from .label_items import parse_displacement as parse_displacement
from .label_items import scene_shots as scene_shots
from .layouts import LayoutMenu as LayoutMenu
from .layouts import LayoutsPresenter as LayoutsPresenter
from .live import LivePage as LivePage
from .live import LivePresenter as LivePresenter
from .live import WorkspacePage as WorkspacePage
from .live import column_of as column_of
from .live import limit_height as limit_height
from .run_story import ProbeStory as ProbeStory
from .run_story import RunStory as RunStory
from .run_story import TrialStory as TrialStory
from .run_story import belief_scene as belief_scene
from .run_story import face_outlines as face_outlines
from .run_story import run_score as run_score
from .run_story import true_patch_outline as true_patch_outline
from .run_story import unprobed_scene as unprobed_scene
from .saving import MainThreadQueue as MainThreadQueue
from .saving import SaveAction as SaveAction
from .saving import SaveQueue as SaveQueue
from .saving import SaveWorker as SaveWorker
from .settings import WindowSettings as WindowSettings
from .settings import ignored_words as ignored_words
from .settings import load_settings as load_settings
from .settings import restore_form as restore_form
from .settings import save_settings as save_settings
from .settings import settings_path as settings_path
from .sheets import BenchSheet as BenchSheet
from .sheets import FileDrop as FileDrop
from .sheets import QuestionRow as QuestionRow
from .sheets import ask_path as ask_path
from .top_bar import DeviceChipsPresenter as DeviceChipsPresenter
from .top_bar import ServoSwitch as ServoSwitch
from .top_bar import SpeedOverride as SpeedOverride
from .top_bar import pill_state as pill_state
from .window import USUAL as USUAL
from .window import Appearance as Appearance
from .window import MainWindow as MainWindow
from .window import move_on_screen as move_on_screen
from .workspace import Memory as Memory
from .workspace import WindowCommand as WindowCommand
from .workspace import Workspace as Workspace
from .workspace import WorkspaceContext as WorkspaceContext

__all__ = [
    "ACTIVE_STATES",
    "CURSOR_S",
    "LIFT",
    "LIFT_MM",
    "USUAL",
    "ActionRegistry",
    "Appearance",
    "BenchSheet",
    "CloseConfirmation",
    "CommandDialogs",
    "DeviceChipsPresenter",
    "DeviceInspectorPresenter",
    "ErrorBox",
    "FileDrop",
    "LabelDraft",
    "LabelItem",
    "LabelSheets",
    "LayoutMenu",
    "LayoutsPresenter",
    "LivePage",
    "LivePresenter",
    "MainThreadQueue",
    "MainWindow",
    "Memory",
    "ModelPrelabeller",
    "OpenedDataset",
    "PersonCalls",
    "PrelabelFunction",
    "ProbeStory",
    "QuestionRow",
    "RunStory",
    "SaveAction",
    "SaveQueue",
    "SaveWorker",
    "ServoSwitch",
    "SpeedOverride",
    "StopKeyFilter",
    "TrialStory",
    "WindowCommand",
    "WindowSettings",
    "Workspace",
    "WorkspaceContext",
    "WorkspacePage",
    "arm_of",
    "arm_position_mm",
    "as_float_pair",
    "ask_path",
    "belief_scene",
    "bench_caption",
    "carry_out",
    "column_of",
    "count_noun",
    "duration_text",
    "error_card",
    "exit_after_timeout",
    "face_outlines",
    "gripper_of",
    "ignored_words",
    "install_error_hooks",
    "is_pressing",
    "is_run_active",
    "is_typing",
    "item_reader",
    "key_bindings",
    "lift_hand",
    "limit_height",
    "load_settings",
    "log",
    "log_event",
    "log_to",
    "may_be_moving",
    "missing_scene_reason",
    "model_path_in_use",
    "move_on_screen",
    "open_dataset",
    "parse_displacement",
    "pill_state",
    "portable_key",
    "restore_form",
    "run_model_caption",
    "run_score",
    "save_settings",
    "scene_model_caption",
    "scene_shots",
    "settings_path",
    "show_event",
    "start_obstacle",
    "stopped_card",
    "time_of_day",
    "true_patch_outline",
    "unprobed_scene",
]
