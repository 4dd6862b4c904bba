"""Message types of drivers that bags need not describe: sqlite3 bags before ROS 2 Iron do not.

Fields and their order as the drivers publish them.
"""

from __future__ import annotations

from collections.abc import Mapping

WITHOUT_HEADER = ("ublox_msgs/msg/NavPVT", "novatel_msgs/msg/INSPVAX")
"""Types of motion data that do not begin with a `std_msgs/Header`."""

_HEADER = "std_msgs/Header header\n"

_INSPVAX = """
float64 latitude
float64 longitude
float64 {height}
float32 undulation
float64 north_velocity
float64 east_velocity
float64 up_velocity
float64 roll
float64 pitch
float64 azimuth
float32 latitude_{std}
float32 longitude_{std}
float32 {height}_{std}
float32 north_velocity_{std}
float32 east_velocity_{std}
float32 up_velocity_{std}
float32 roll_{std}
float32 pitch_{std}
float32 azimuth_{std}
"""

DEFINITIONS: Mapping[str, str] = {
    "novatel_oem7_msgs/msg/Oem7Header": """
string message_name
uint16 message_id
uint8 message_type
uint32 sequence_number
uint8 time_status
uint16 gps_week_number
uint32 gps_week_milliseconds
""",
    "novatel_oem7_msgs/msg/InertialSolutionStatus": "uint32 status\n",
    "novatel_oem7_msgs/msg/PositionOrVelocityType": "uint32 type\n",
    "novatel_oem7_msgs/msg/INSExtendedSolutionStatus": "uint32 status\n",
    "novatel_oem7_msgs/msg/INSPVAX": _HEADER
    + "Oem7Header nov_header\nInertialSolutionStatus ins_status\nPositionOrVelocityType pos_type"
    + _INSPVAX.format(height="height", std="stdev")
    + "INSExtendedSolutionStatus ext_sol_status\nuint16 time_since_update\n",
    "novatel_msgs/msg/CommonHeader": """
uint16 id
uint8 msg_type
uint8 port_addr
uint8 length
uint8 sequence
uint16 idle_time
uint16 time_stat
uint16 week
int32 gpssec
uint32 rcvrstat
uint16 reserved_h
uint16 version_sw
""",
    "novatel_msgs/msg/INSPVAX": "CommonHeader header\nuint32 ins_status\nuint32 position_type"
    + _INSPVAX.format(height="altitude", std="std")
    + "uint32 extended_status\nuint16 seconds_since_update\n",
    "ublox_msgs/msg/NavPVT": """
uint32 i_tow
uint16 year
uint8 month
uint8 day
uint8 hour
uint8 min
uint8 sec
uint8 valid
uint32 t_acc
int32 nano
uint8 fix_type
uint8 flags
uint8 flags2
uint8 num_sv
int32 lon
int32 lat
int32 height
int32 h_msl
uint32 h_acc
uint32 v_acc
int32 vel_n
int32 vel_e
int32 vel_d
int32 g_speed
int32 heading
uint32 s_acc
uint32 head_acc
uint16 p_dop
uint8[6] reserved1
int32 head_veh
int16 mag_dec
uint16 mag_acc
""",
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": _HEADER + "VelodynePacket[] packets\n",
    "septentrio_gnss_driver/msg/BlockHeader": """
uint8 sync_1
uint8 sync_2
uint16 crc
uint16 id
uint8 revision
uint16 length
uint32 tow
uint16 wnc
""",
    "septentrio_gnss_driver/msg/PVTGeodetic": _HEADER
    + """BlockHeader block_header
uint8 mode
uint8 error
float64 latitude
float64 longitude
float64 height
float32 undulation
float32 vn
float32 ve
float32 vu
float32 cog
float64 rx_clk_bias
float32 rx_clk_drift
uint8 time_system
uint8 datum
uint8 nr_sv
uint8 wa_corr_info
uint16 reference_id
uint16 mean_corr_age
uint32 signal_info
uint8 alert_flag
uint8 nr_bases
uint16 ppp_info
uint16 latency
uint16 h_accuracy
uint16 v_accuracy
uint8 misc
""",
}
"""Text of a .msg file by type."""
