"""SLAM beside an installed ROS 2, for computers that Cyclone DDS has no wheel for, as ARM boards.

It starts `uwb-slam run` with the arguments that it gets, gives it the poses of /odom on standard
input, and publishes what comes back as lines of JSON: tf from map to odom, and the pose with its
covariance. `ros2:` does the same and more without an installation of ROS; see docs/robot.md.

It needs rclpy, which is not installed where this project is tested: it has been tried with a
stand-in for rclpy only.

```console
$ source /opt/ros/jazzy/setup.bash
$ python3 18_ros2_bridge.py --rig robot.toml --out out/run
```

```text
...
```
"""

import json
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.time import Time
from tf2_ros import TransformBroadcaster

COMMAND = ["uwb-slam", "run", "--odometry", "-", "--publish", "jsonl:-", *sys.argv[1:]]
slam = subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
wheels: deque[tuple[float, ...]] = deque(maxlen=1000)  # time [ns], x, y [m], heading [rad]

rclpy.init()
node = rclpy.create_node("uwb_slam")
poses = node.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
broadcaster = TransformBroadcaster(node)


def on_odometry(message: Odometry) -> None:
    stamp, place = message.header.stamp, message.pose.pose.position
    turn = message.pose.pose.orientation
    numbers = f"{place.x!r} {place.y!r} 0 0 0 {turn.z!r} {turn.w!r}"
    print(f"{stamp.sec}.{stamp.nanosec:09d} {numbers}", file=slam.stdin, flush=True)
    heading = 2.0 * np.arctan2(turn.z, turn.w)
    wheels.append((stamp.sec * 10**9 + stamp.nanosec, place.x, place.y, heading))


def publish(state: dict) -> None:
    times, xs, ys, headings = np.array(wheels).T
    at = [np.interp(state["t_ns"], times, row) for row in (xs, ys, np.unwrap(headings))]
    x, y, heading = state["pose"]
    turn = heading - at[2]
    link, pose = TransformStamped(), PoseWithCovarianceStamped()
    link.header.frame_id, link.child_frame_id, pose.header.frame_id = "map", "odom", "map"
    link.header.stamp = pose.header.stamp = Time(nanoseconds=state["t_ns"]).to_msg()
    link.transform.translation.x = x - np.cos(turn) * at[0] + np.sin(turn) * at[1]
    link.transform.translation.y = y - np.sin(turn) * at[0] - np.cos(turn) * at[1]
    link.transform.rotation.z, link.transform.rotation.w = np.sin(turn / 2), np.cos(turn / 2)
    place, orientation = pose.pose.pose.position, pose.pose.pose.orientation
    place.x, place.y = x, y
    orientation.z, orientation.w = np.sin(heading / 2), np.cos(heading / 2)
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = np.reshape(state["covariance"], (3, 3))
    pose.pose.covariance = covariance.ravel()
    broadcaster.sendTransform(link)
    poses.publish(pose)


def read() -> None:
    for line in slam.stdout:
        if (state := json.loads(line))["kind"] == "state":
            publish(state)
    rclpy.shutdown()


node.create_subscription(Odometry, "odom", on_odometry, 100)
threading.Thread(target=read, daemon=True).start()
with suppress(KeyboardInterrupt):  # `uwb-slam run` gets it, too, and writes its results
    rclpy.spin(node)
slam.stdin.close()
sys.exit(slam.wait())
