"""Messages of receivers and inertial systems, from the fixes and poses of a simulated drive."""

from __future__ import annotations

import datetime
import math
from typing import Any

import numpy as np
import pymap3d

from caliv_graph.scenario.sensor_models import GnssModel
from scripts._dialects_motion import time_message

POSES = {"inspvax": "novatel_oem7_msgs/msg/INSPVAX", "novatel": "novatel_msgs/msg/INSPVAX"}
FIXES = {
    "navpvt": "ublox_msgs/msg/NavPVT",
    "pvt": "septentrio_gnss_driver/msg/PVTGeodetic",
    "station": "geometry_msgs/msg/PoseStamped",
}


def navpvt(fix: Any, stamp: int, gnss: GnssModel) -> dict[str, Any]:
    """A NavSatFix as the receiver would report it."""
    t = datetime.datetime.fromtimestamp(stamp // 10**9, tz=datetime.UTC)
    horizontal, vertical = math.sqrt(2 * fix.position_covariance[0]), fix.position_covariance[8]
    return {
        **{"year": t.year, "month": t.month, "day": t.day, "hour": t.hour, "min": t.minute},
        **{"sec": t.second, "nano": stamp % 10**9, "valid": 7, "fix_type": 3, "flags": 1},
        "lat": round(fix.latitude * 1e7),
        "lon": round(fix.longitude * 1e7),
        "height": round(fix.altitude * 1e3),
        "h_acc": round(1e3 * horizontal),
        "v_acc": round(1e3 * math.sqrt(vertical)),
    }


def pvt(fix: Any, stamp: int, gnss: GnssModel) -> dict[str, Any]:
    """A NavSatFix as a Septentrio reports it: radians; 2DRMS and two sigma in centimetres."""
    cov = fix.position_covariance
    return {
        "mode": 4,
        "latitude": math.radians(fix.latitude),
        "longitude": math.radians(fix.longitude),
        "height": fix.altitude,
        "h_accuracy": round(1e2 * 2.0 * math.sqrt(2.0 * cov[0])),
        "v_accuracy": round(1e2 * 2.0 * math.sqrt(cov[8])),
    }


def station(fix: Any, stamp: int, gnss: GnssModel) -> dict[str, Any]:
    """A NavSatFix as a total station 360 m away reports a prism: axes of the map, no rotation."""
    origin = (gnss.latitude_deg, gnss.longitude_deg, gnss.altitude_m)
    east, north, up = pymap3d.geodetic2enu(fix.latitude, fix.longitude, fix.altitude, *origin)
    place = {"x": float(east) + 300.0, "y": float(north) - 200.0, "z": float(up) + 5.0}
    return {"pose": {"position": place, "orientation": {"w": 1.0}}}


RECEIVERS = {"navpvt": navpvt, "pvt": pvt, "station": station}


def serialised(store: Any, kind: str, stamp: int, fields: dict[str, Any]) -> bytes:
    """A message whose other fields are zero; the status of an INS is good."""

    def built(name: str, given: dict[str, Any]) -> Any:
        values = {}
        for field, (node, detail) in store.fielddefs[name][1]:
            if int(node) == 2:
                values[field] = built(detail, given.get(field, {}))
            elif isinstance(given.get(field), list):
                values[field] = [built(detail[0][1], item) for item in given[field]]
            elif int(node) == 1:
                values[field] = given.get(field, "" if detail[0] == "string" else 0)
            else:
                values[field] = given.get(field, np.zeros(detail[1], detail[0][1][0]))
        return store.types[name](**values)

    header = {"stamp": time_message(stamp)}
    if kind == POSES["novatel"]:
        fields = {**fields, "ins_status": 3}
    elif kind == POSES["inspvax"]:
        fields = {**fields, "header": header, "ins_status": {"status": 3}}
    elif kind in (FIXES["pvt"], FIXES["station"]):
        fields = {**fields, "header": header}
    return bytes(store.serialize_cdr(built(kind, fields), kind))
