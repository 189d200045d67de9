"""ROS 2 bags: a folder per episode with its file and ``metadata.yaml`` for ``ros2 bag``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

from touchdown.backend.core import InputError
from touchdown.backend.episodes import STATIC_TOPIC, read_whole
from touchdown.backend.exchange.exports import ExportJob

VERSION = 5  # of the metadata: ROS 2 Humble and later read it


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Copy the file of every episode into a bag; raises ``InputError`` for packed episodes."""
    if any(one.entry.mode == "mass" for one in job.chosen):
        raise InputError("Packed episodes have no signals.", "ros2", "Choose recorded episodes.")
    for one in job.chosen:
        bag, name = folder / one.entry.uuid, f"{one.entry.uuid}.mcap"
        bag.mkdir()
        shutil.copyfile(job.dataset.folder / one.entry.path, bag / name)
        metadata = json.dumps(_metadata(bag / name), indent=2)  # JSON is YAML
        (bag / "metadata.yaml").write_text(metadata, "utf-8")
        job.advance(one.index + 1)
    return {"data": "mcap, cdr", "metadata_version": VERSION}


def _metadata(file: Path) -> dict[str, object]:
    whole = read_whole(file)
    counts = {name: len(messages) for name, messages in whole.messages.items()}
    start_ns = min(whole.log_ns)
    span = {"starting_time": {"nanoseconds_since_epoch": start_ns},
            "duration": {"nanoseconds": max(whole.log_ns) - start_ns},
            "message_count": sum(counts.values())}  # fmt: skip
    topics = [
        {"message_count": count, "topic_metadata": {
            "name": name, "type": whole.schemas[name], "serialization_format": "cdr",
            "offered_qos_profiles": STATIC_TOPIC.qos if name == STATIC_TOPIC.name else "",
        }}
        for name, count in counts.items()
    ]  # fmt: skip
    content = {"version": VERSION, "storage_identifier": "mcap", "relative_file_paths": [file.name],
               **span, "topics_with_message_count": topics, "compression_format": "",
               "compression_mode": "", "files": [{"path": file.name, **span}]}  # fmt: skip
    return {"rosbag2_bagfile_information": content}
