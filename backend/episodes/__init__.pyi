from .episode_mcap import REST_KEY as REST_KEY
from .episode_mcap import START_KEY as START_KEY
from .episode_mcap import CompressedEpisode as CompressedEpisode
from .episode_mcap import CompressedImages as CompressedImages
from .episode_mcap import KeepFrames as KeepFrames
from .episode_mcap import episode_of as episode_of
from .episode_mcap import read_compressed_episode as read_compressed_episode
from .episode_mcap import read_episode as read_episode
from .episode_mcap import salvage_file as salvage_file
from .episode_mcap import to_ns as to_ns
from .episode_mcap import without_images as without_images
from .episode_mcap import write_episode as write_episode
from .mcap_container import DAMAGED_FILE_FIX as DAMAGED_FILE_FIX
from .mcap_container import StoredChunk as StoredChunk
from .mcap_container import input_errors as input_errors
from .mcap_container import read_chunk as read_chunk
from .mcap_container import read_chunks as read_chunks
from .mcap_container import read_first as read_first
from .mcap_container import read_groups as read_groups
from .mcap_container import read_whole as read_whole
from .messages import COMMAND_TOPIC as COMMAND_TOPIC
from .messages import LABEL_TOPIC as LABEL_TOPIC
from .messages import OBSERVATION_TOPIC as OBSERVATION_TOPIC
from .messages import unpack_json as unpack_json
from .messages import unpack_observation as unpack_observation
from .packs import PackedEpisode as PackedEpisode
from .packs import write_packs as write_packs
from .quality import Coverage as Coverage
from .quality import ExaminedEpisode as ExaminedEpisode
from .quality import QualityIssue as QualityIssue
from .quality import check_quality as check_quality
from .quality import count_coverage as count_coverage
from .training_rows import MIN_MOUNTINGS as MIN_MOUNTINGS
from .training_rows import Split as Split
from .training_rows import TrainingRows as TrainingRows
from .training_rows import divided_indices as divided_indices
from .training_rows import find_packs as find_packs
from .training_rows import group_noun as group_noun
from .training_rows import join_rows as join_rows
from .training_rows import load_rows as load_rows
from .training_rows import patch_bits as patch_bits
from .training_rows import patch_hex as patch_hex
from .training_rows import split_grips as split_grips
from .training_rows import split_rows as split_rows
from .training_rows import split_series as split_series

__all__ = [
    "COMMAND_TOPIC",
    "DAMAGED_FILE_FIX",
    "LABEL_TOPIC",
    "MIN_MOUNTINGS",
    "OBSERVATION_TOPIC",
    "REST_KEY",
    "START_KEY",
    "CompressedEpisode",
    "CompressedImages",
    "Coverage",
    "ExaminedEpisode",
    "KeepFrames",
    "PackedEpisode",
    "QualityIssue",
    "Split",
    "StoredChunk",
    "TrainingRows",
    "check_quality",
    "count_coverage",
    "divided_indices",
    "episode_of",
    "find_packs",
    "group_noun",
    "input_errors",
    "join_rows",
    "load_rows",
    "patch_bits",
    "patch_hex",
    "read_chunk",
    "read_chunks",
    "read_compressed_episode",
    "read_episode",
    "read_first",
    "read_groups",
    "read_whole",
    "salvage_file",
    "split_grips",
    "split_rows",
    "split_series",
    "to_ns",
    "unpack_json",
    "unpack_observation",
    "without_images",
    "write_episode",
    "write_packs",
]
