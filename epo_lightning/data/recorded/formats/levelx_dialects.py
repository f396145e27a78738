"""Differences between the data sets of the levelXdata family (exiD, highD, inD, rounD, uniD), as a table.

All have ``NN_tracks.csv``, ``NN_tracksMeta.csv`` and ``NN_recordingMeta.csv`` per recording, in metres, seconds and degrees.
The reader (:mod:`~epo_lightning.data.recorded.formats.levelx`) knows the columns by exiD's names; a dialect says what they
are called elsewhere and in which frame of reference they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

LANELET2, MARKINGS = "lanelet2", "markings"
"""Sources of lanes: a Lanelet2 map per location, or the lane markings in recordingMeta."""


@dataclass(frozen=True)
class Dialect:
    """One data set of the family.

    Attributes:
        title: name of the data set in messages.
        names: names of columns in its files, by the name in exiD, where they differ; None for a column that it lacks.
        corner: whether x and y are the corner of the box with the smallest coordinates, and not its centre. The extents of
            the box are then along x and y.
        y_down: whether y points down as in an image.
        directed: whether headings are not recorded and follow from ``drivingDirection`` of tracksMeta (1 is towards
            smaller x, 2 towards larger x) and velocities.
        lanes: LANELET2 or MARKINGS.
        map_needed: whether a recording without a map is an error. Else its recordings are read without lanes.
        map_folders: folders of Lanelet2 maps, relative to that of the data set.
        kinds: kinds of agents by further names of classes.
        sizeless: kinds of agents whose size may not be annotated (0, 0).
        limit_needed: whether recordingMeta must have a column ``speedLimit``.
        by_location: whether recordings of one location are one group; else each recording is a group.
    """

    title: str
    names: Mapping[str, str | None] = field(default_factory=dict)
    corner: bool = False
    y_down: bool = False
    directed: bool = False
    lanes: str = LANELET2
    map_needed: bool = False
    map_folders: tuple[str, ...] = ("maps/lanelet2", "maps/lanelets", "maps", "lanelet2", "lanelets")
    kinds: Mapping[str, str] = field(default_factory=dict)
    sizeless: tuple[str, ...] = ("motorcycle", "bicycle", "pedestrian")
    limit_needed: bool = False
    by_location: bool = True

    def column(self, name: str) -> str | None:
        """Name of a column in the files of this data set, by its name in exiD; None if there is none."""
        return self.names.get(name, name)


CLASSES = {"truck_bus": "truck", "trailer": "truck", "cyclist": "bicycle", "animal": "other"}
"""Kinds by class names of inD, rounD and uniD that the framework has no kind of their own for."""

DIALECTS: Mapping[str, Dialect] = {
    "exid": Dialect("exiD", map_needed=True, map_folders=("maps/lanelet2",), limit_needed=True),
    "highd": Dialect(
        "highD",
        names={
            "recordingId": None,
            "trackId": "id",
            "xCenter": "x",
            "yCenter": "y",
            "heading": None,
            "length": "width",
            "width": "height",
            "xUtmOrigin": None,
            "yUtmOrigin": None,
        },
        corner=True,
        y_down=True,
        directed=True,
        lanes=MARKINGS,
        sizeless=(),
    ),
    "ind": Dialect("inD", kinds=CLASSES),
    # Nearly all recordings of rounD, and all of uniD, are of one place.
    "round": Dialect("rounD", kinds=CLASSES, by_location=False),
    "unid": Dialect("uniD", kinds=CLASSES, by_location=False),
}
"""Dialects by the name of their format."""
