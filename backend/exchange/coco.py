"""COCO-like JSON: the bottom face as a canvas, the contact patch as an annotation on it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend.annotations import Dataset, Label, Pair, content_hash
from touchdown.backend.core import FloatArray, InputError, parse_json
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.label_import import ImportedLabel, label_file
from touchdown.backend.exchange.query import SelectedEpisode
from touchdown.backend.geometry import overlap_polygon, rings_of, rotated

FILE = "annotations.json"
PX_PER_MM = 20.0
MARGIN_MM = 12.0
VISIBLE = 2
DECIMALS = 4
FLIP = np.array([1.0, -1.0])  # rows of an image run downwards
MIN_IOU = 0.99
EDGE_PX = 1.0  # rounding of a polygon moves its edge by up to this
INK, PAPER = 60, 245


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write ``annotations.json`` and one image per pair into ``folder``."""
    images, annotations = [], []
    canvases: dict[str, Canvas] = {}
    for one in job.chosen:
        name = one.revision.geometry
        if name not in canvases:
            canvases[name] = Canvas(job.dataset.geometry.pair(name))
            canvases[name].draw(folder / _file_name(name))
        canvas = canvases[name]
        images.append(_image(one, canvas))
        annotations.append(_annotation(one, canvas))
        job.advance(one.index + 1)
    selected = content_hash([[o.entry.uuid, o.revision.rev_uuid] for o in job.chosen])
    info = {"description": "contact patches", "px_per_mm": PX_PER_MM, "revisions_sha256": selected,
            "origin_px": {name: list(c.origin_px) for name, c in canvases.items()}}  # fmt: skip
    categories = [{"id": 1, "name": "contact", "supercategory": "patch",
                   "keypoints": ["offset", "com"], "skeleton": []}]  # fmt: skip
    content = {"info": info, "images": images, "annotations": annotations, "categories": categories}
    (folder / FILE).write_text(json.dumps(content, ensure_ascii=False), "utf-8")
    return {"data": "json", "px_per_mm": PX_PER_MM}


class Canvas:
    """Transform between mm in the bottom frame and pixels of an image of face and bottom."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        x_mm, y_mm = (extent + MARGIN_MM for extent in pair.bottom.half_extents_mm)
        half = (math.ceil(x_mm * PX_PER_MM), math.ceil(y_mm * PX_PER_MM))
        self.origin_px = half
        self.width, self.height = 2 * half[0] + 1, 2 * half[1] + 1

    def px(self, points_mm: FloatArray) -> FloatArray:
        """Return points (n, 2) of the bottom frame in px."""
        flipped = points_mm * FLIP * PX_PER_MM
        centred = flipped + np.array(self.origin_px, dtype=np.float64)
        return np.asarray(np.round(centred, DECIMALS), dtype=np.float64)

    def draw(self, path: Path) -> None:
        """Draw the outline of the bottom."""
        picture = np.full((self.height, self.width), PAPER, dtype=np.uint8)
        rings = rings_of(self.px(self.pair.bottom.path()))
        corners = [np.rint(ring).astype(np.int32) for ring in rings]
        cv2.polylines(picture, corners, isClosed=True, color=INK, thickness=2)
        path.parent.mkdir(exist_ok=True)
        done, data = cv2.imencode(".png", picture)
        assert done
        path.write_bytes(data.tobytes())


def _file_name(pair: str) -> str:
    return f"images/{pair[:16]}.png"


def _image(one: SelectedEpisode, canvas: Canvas) -> dict[str, object]:
    return {
        "id": one.index + 1,
        "file_name": _file_name(one.revision.geometry),
        "width": canvas.width,
        "height": canvas.height,
        "episode": one.entry.uuid,
        "file_sha256": one.entry.sha256,
        "pair": one.revision.geometry,
        "split": one.split,
    }


def _annotation(one: SelectedEpisode, canvas: Canvas) -> dict[str, object]:
    revision, pair = one.revision, canvas.pair
    offset = revision.label.offset_mm
    yaw_rad = math.radians((revision.label.theta_mdeg or 0) / 1e3)
    x_mm, y_mm = offset.tolist()
    patch_mm = overlap_polygon(pair.face, (x_mm, y_mm), pair.bottom, yaw_rad)
    centre_mm = offset + rotated(np.array(pair.centre_mm), yaw_rad)
    points = [
        value
        for xy in canvas.px(np.stack([offset, centre_mm])).tolist()
        for value in (*xy, VISIBLE)
    ]
    return {
        "id": one.index + 1,
        "image_id": one.index + 1,
        "category_id": 1,
        **_shape(rings_of(canvas.px(patch_mm)), (canvas.height, canvas.width)),
        "iscrowd": 0,
        "keypoints": points,
        "num_keypoints": 2,
        "rev_uuid": revision.rev_uuid,
        "source": revision.source,
        "state": revision.state,
        "label": asdict(revision.label),
    }


def _shape(rings_px: list[FloatArray], size: tuple[int, int]) -> dict[str, object]:
    """Return segmentation, box and area of the rings.

    The format has no holes in polygons: a patch with holes is run-length encoded.
    """
    if not rings_px:
        return {"segmentation": [], "bbox": [0, 0, 0, 0], "area": 0.0}
    every = np.concatenate(rings_px)
    low, high = every.min(axis=0), every.max(axis=0)
    areas = [float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) for x, y in (r.T for r in rings_px)]
    holed = min(areas) * max(areas) < 0.0
    segmentation: object = [ring.reshape(-1).tolist() for ring in rings_px]
    if holed:
        segmentation = {"size": list(size), "counts": _runs(rings_px, size)}
    return {
        "segmentation": segmentation,
        "bbox": np.round([*low, *(high - low)], DECIMALS).tolist(),
        "area": round(0.5 * abs(sum(areas)), DECIMALS),
    }


def _runs(rings_px: list[FloatArray], size: tuple[int, int]) -> list[int]:
    """Return the run lengths, column by column, of the pixels whose centres are inside.

    The first run is outside. Inside is by the odd-even rule.
    """
    crossed = np.zeros((size[1], size[0]), dtype=np.bool_)
    for ring in rings_px:
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            columns = np.arange(math.ceil(min(x0, x1)), math.ceil(max(x0, x1)))
            rows = np.ceil(y0 + (columns - x0) * (y1 - y0) / ((x1 - x0) or 1.0)).astype(np.intp)
            crossed[columns, rows] ^= True
    inside = np.logical_xor.accumulate(crossed, axis=1).reshape(-1)
    ends = np.flatnonzero(np.diff(inside, prepend=False)).tolist()
    return [int(run) for run in np.diff([0, *ends, inside.size])]


def read_coco(source: Path, dataset: Dataset) -> Iterator[ImportedLabel]:
    """Yield the offsets of ``annotations.json``; rows whose polygon does not fit carry a warning.

    Raises ``InputError`` if the file is damaged or foreign.
    """
    path = label_file(source, FILE)
    try:
        content = parse_json(path.read_bytes())
        origins, scale = content["info"]["origin_px"], float(content["info"]["px_per_mm"])
        images = {image["id"]: image for image in content["images"]}
        for annotation in content["annotations"]:
            image = images[annotation["image_id"]]
            origin = np.array(origins[image["pair"]], dtype=np.float64).reshape(2)
            yield _row(annotation, image, (origin, scale), dataset)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else error
        raise InputError(
            f"The annotations cannot be read: {why}.", str(path), "Export them again."
        ) from error


def _row(
    annotation: Mapping[str, Any],
    image: Mapping[str, Any],
    frame: tuple[FloatArray, float],
    dataset: Dataset,
) -> ImportedLabel:
    """Return one offset; ``frame``: origin of the bottom frame in px, and px a mm."""
    origin_px, px_per_mm = frame
    at_px = np.array(annotation["keypoints"][:2], dtype=np.float64)
    x_mm, y_mm = ((at_px - origin_px) / px_per_mm * FLIP).tolist()
    x_um, y_um = round(x_mm * 1e3), round(y_mm * 1e3)
    was = Label(**annotation["label"]) if "label" in annotation else None
    moved = was is None or (was.x_um, was.y_um) != (x_um, y_um)
    theta_mdeg = None if was is None else was.theta_mdeg
    # the uncertainty of a moved label is unknown
    label = Label(x_um, y_um, theta_mdeg, None if moved or was is None else was.sigma_um)
    warning = ""
    if annotation["segmentation"]:
        pair = dataset.geometry.pair(str(image["pair"]))
        points = rotated(pair.points_mm, math.radians((label.theta_mdeg or 0) / 1e3))
        points_px = (points + label.offset_mm) * FLIP * px_per_mm + origin_px
        touching = dataset.geometry.patch(pair.sha256, label).touching
        share = _iou(annotation["segmentation"], points_px, touching)
        if share < MIN_IOU:
            warning = f"its polygon and the patch of its offset overlap by {share:.2f} only"
    return ImportedLabel(str(image["episode"]), str(image.get("file_sha256", "")), label, warning)


def _iou(segmentation: Any, points_px: FloatArray, touching: NDArray[np.bool_]) -> float:
    """Return the overlap of the points (n, 2) within a drawn patch with the derived one (n,).

    Rounding of the corners may move the edge, so points near it are not compared.
    """
    if isinstance(segmentation, Mapping):
        inside, near = _within_runs(segmentation, points_px)
    else:
        rings = [np.array(ring, dtype=np.float64).reshape(-1, 2) for ring in segmentation]
        inside, near = _within_rings(rings, points_px)
    drawn = np.where(near, touching, inside)
    union = int((drawn | touching).sum())
    return int((drawn & touching).sum()) / union if union else 1.0


Within = tuple[NDArray[np.bool_], NDArray[np.bool_]]  # inside, near the edge


def _within_runs(runs: Mapping[str, Any], points_px: FloatArray) -> Within:
    height, width = (int(n) for n in runs["size"])
    counts = np.array(runs["counts"], dtype=np.intp)
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    mask = np.pad(flat.reshape(width, height), 2)
    at = np.clip(np.rint(points_px).astype(np.intp), -1, [width, height]) + 2
    around = np.stack(
        [mask[at[:, 0] + i, at[:, 1] + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=1
    )
    inside = around[:, 4]
    return inside, (around != inside[:, None]).any(axis=1)


def _within_rings(rings_px: list[FloatArray], points_px: FloatArray) -> Within:
    import shapely

    rings = [shapely.Polygon(ring) for ring in rings_px]
    edges = shapely.MultiLineString([ring.exterior for ring in rings])
    near = shapely.distance(edges, shapely.points(points_px)) < EDGE_PX
    inside = sum(shapely.contains_xy(ring, *points_px.T).astype(int) for ring in rings)
    return inside % 2 == 1, near
