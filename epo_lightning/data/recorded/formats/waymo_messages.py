"""Messages of Waymo Open Motion that are read: names, numbers and types of their fields, as published in scenario.proto and
map.proto (github.com/waymo-research/waymo-open-dataset). The parser skips all other fields.

The names of the types of the data set's own enumerations are constants here: on the wire, an enumeration is an int32.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

VEHICLE, PEDESTRIAN, CYCLIST, OTHER = 1, 2, 3, 4
"""Values of ``Track.object_type``; 0 is unset."""
BIKE_LANE = 3
"""Value of ``LaneCenter.type`` for bicycle lanes; 1 is a freeway, 2 a surface street."""
SOLID = {2, 3, 6, 7}
"""Values of ``BoundarySegment.boundary_type`` for lines that may not be crossed, single or double, white or yellow."""

MESSAGES: dict[str, dict[str, tuple[int, str]]] = {
    "ObjectState": {
        "center_x": (2, "double"),
        "center_y": (3, "double"),
        "length": (5, "float"),
        "width": (6, "float"),
        "heading": (8, "float"),
        "velocity_x": (9, "float"),
        "velocity_y": (10, "float"),
        "valid": (11, "bool"),
    },
    "Track": {"id": (1, "int32"), "object_type": (2, "int32"), "states": (3, "repeated ObjectState")},
    "MapPoint": {"x": (1, "double"), "y": (2, "double")},
    "BoundarySegment": {
        "lane_start_index": (1, "int32"),
        "lane_end_index": (2, "int32"),
        "boundary_feature_id": (3, "int64"),
        "boundary_type": (4, "int32"),
    },
    "LaneNeighbor": {
        "feature_id": (1, "int64"),
        "self_start_index": (2, "int32"),
        "self_end_index": (3, "int32"),
        "boundaries": (6, "repeated BoundarySegment"),
    },
    "LaneCenter": {
        "speed_limit_mph": (1, "double"),
        "type": (2, "int32"),
        "polyline": (8, "repeated MapPoint"),
        "entry_lanes": (9, "repeated int64"),
        "exit_lanes": (10, "repeated int64"),
        "left_neighbors": (11, "repeated LaneNeighbor"),
        "right_neighbors": (12, "repeated LaneNeighbor"),
        "left_boundaries": (13, "repeated BoundarySegment"),
        "right_boundaries": (14, "repeated BoundarySegment"),
    },
    "RoadLine": {"polyline": (2, "repeated MapPoint")},
    "RoadEdge": {"polyline": (2, "repeated MapPoint")},
    "MapFeature": {
        "id": (1, "int64"),
        "lane": (3, "LaneCenter"),
        "road_line": (4, "RoadLine"),
        "road_edge": (5, "RoadEdge"),
    },
    "Scenario": {
        "timestamps_seconds": (1, "repeated double"),
        "tracks": (2, "repeated Track"),
        "scenario_id": (5, "bytes"),
        "map_features": (8, "repeated MapFeature"),
    },
}
"""Number and type of each field by message. A repeated number is read packed or not, as it comes."""


@cache
def scenario_class() -> Any:
    """The class of the message ``Scenario``."""
    types = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="epo_waymo.proto", package="epo_waymo", syntax="proto2")
    for message, fields in MESSAGES.items():
        described = file.message_type.add(name=message)
        for name, (number, kind) in fields.items():
            *repeated, kind = kind.split()
            field = described.field.add(
                name=name, number=number, label=types.LABEL_REPEATED if repeated else types.LABEL_OPTIONAL
            )
            if kind in MESSAGES:
                field.type, field.type_name = types.TYPE_MESSAGE, f".epo_waymo.{kind}"
            else:
                field.type = types.Type.Value(f"TYPE_{kind.upper()}")
    # A pool of its own: the package with the original messages may be installed too.
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("epo_waymo.Scenario"))
