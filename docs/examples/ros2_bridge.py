"""A NatNet stream as ROS 2 topics: /bodies/NAME/pose (PoseStamped) and /tf, in the frame "world".

    mosca replay run --loop                                        # or Motive, or 'mosca live ... --stream natnet'
    pip install natnet && python ros2_bridge.py 127.0.0.1          # where ROS 2 is installed (rclpy)

Stamps are the middle of the exposure; the fastest frame's way from its transmission to here counts as no time.
"""

import sys
import time
from types import SimpleNamespace


class ServerClock:
    """Time of day [ns] of the server's ticks of 100 ns."""

    day_minus_server_ns = 2**63

    def heard(self, transmit_ticks, day_ns):
        """Take a frame's stamp of transmission, and when it came."""
        self.day_minus_server_ns = min(self.day_minus_server_ns, day_ns - transmit_ticks * 100)

    def day_ns(self, ticks):
        """Return a stamp of the server as time of day."""
        return ticks * 100 + self.day_minus_server_ns


def messages(frame, names, day_ns, msg):
    """Return ({topic: PoseStamped}, TFMessage) of a frame of the package natnet; ``msg``: the messages' classes."""
    stamp = msg.Time(sec=day_ns // 10**9, nanosec=day_ns % 10**9)
    header = msg.Header(stamp=stamp, frame_id="world")
    poses, transforms = {}, []
    for body in (one for one in frame.rigid_bodies if one.tracking_valid):
        x, y, z = body.pos
        a, b, c, d = body.rot
        turn, name = msg.Quaternion(x=a, y=b, z=c, w=d), names[body.id_num]
        pose = msg.Pose(position=msg.Point(x=x, y=y, z=z), orientation=turn)
        poses[f"/bodies/{name}/pose"] = msg.PoseStamped(header=header, pose=pose)
        moved = msg.Transform(translation=msg.Vector3(x=x, y=y, z=z), rotation=turn)
        transforms.append(msg.TransformStamped(header=header, child_frame_id=name, transform=moved))
    return poses, msg.TFMessage(transforms=transforms)


def main(server):
    """Bridge until Ctrl-C."""
    import builtin_interfaces.msg as time_msg
    import geometry_msgs.msg as geometry_msg
    import rclpy
    import std_msgs.msg as std_msg
    import tf2_msgs.msg as tf2_msg
    from natnet import NatNetClient

    msg = SimpleNamespace(
        **{k: v for room in (time_msg, geometry_msg, std_msg, tf2_msg) for k, v in vars(room).items()}
    )
    rclpy.init()
    node, clock, names, publishers = rclpy.create_node("mosca_bridge"), ServerClock(), {}, {}
    tf = node.create_publisher(msg.TFMessage, "/tf", 10)

    def publish(frame):
        clock.heard(frame.suffix.stamp_transmit, time.time_ns())
        if all(body.id_num in names for body in frame.rigid_bodies):
            day_ns = clock.day_ns(frame.suffix.stamp_camera_mid_exposure)
            poses, transforms = messages(frame, names, day_ns, msg)
            for topic, pose in poses.items():
                if topic not in publishers:
                    publishers[topic] = node.create_publisher(msg.PoseStamped, topic, 10)
                publishers[topic].publish(pose)
            tf.publish(transforms)

    def learn(model):
        names.update({one.id_num: one.name for one in model.rigid_bodies})

    client = NatNetClient(server, "0.0.0.0", use_multicast=False)
    client.on_data_description_received_event.handlers.append(learn)
    client.on_data_frame_received_event.handlers.append(publish)
    with client:
        client.request_modeldef()
        client.run_async()
        rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv[1:] or ["127.0.0.1"])
