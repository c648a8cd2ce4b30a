"""What the package ``natnet`` reads in messages, as this project's values, and messages of recorded traffic."""

import struct

import numpy as np
import pytest

from hardware.streams.natnet.messages import FrameStamps
from hardware.streams.values import BODY, MARKER, NO_POINTS, StreamedBody, StreamedSet, StreamedSkeleton, StreamFrame


def natnet():
    """Return the witness; skip without it."""
    return pytest.importorskip("natnet", reason="natnet is not installed (pip install 'mosca-testbench[bench]')")


def parsed_frame(message, version):
    """Return what the witness reads in a frame of data."""
    witness = natnet()
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version

    buffer = PacketBuffer(message)
    buffer.pointer = 4
    return witness.DataFrame.read_from_buffer(buffer, Version(*version)), buffer.pointer


def parsed_model(message, version):
    """Return what the witness reads in model definitions, and where it stops."""
    witness = natnet()
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version

    buffer = PacketBuffer(message)
    buffer.pointer = 4
    return witness.DataDescriptions.read_from_buffer(buffer, Version(*version)), buffer.pointer


def _bodies(found):
    rows = [(b.id_num, b.pos, b.rot, b.marker_error, int(b.tracking_valid)) for b in found]
    return np.array(rows, BODY)


def frame_of(found):
    """Return the witness's frame as a ``StreamFrame`` and its stamps."""
    end = found.suffix
    frame = StreamFrame(
        number=found.prefix.frame_number,
        timestamp_s=end.timestamp,
        marker_sets=tuple(
            (one.model_name, np.array(one.marker_pos_list, "<f4").reshape(-1, 3)) for one in found.marker_sets
        ),
        other=np.array(found.unlabeled_marker_pos, "<f4").reshape(-1, 3) if found.unlabeled_marker_pos else NO_POINTS,
        bodies=_bodies(found.rigid_bodies),
        skeletons=tuple((one.id_num, _bodies(one.rigid_bodies)) for one in found.skeletons),
        markers=np.array([(m.id_num, m.pos, m.size, m.param, m.residual) for m in found.labeled_markers], MARKER),
        timecode=(end.timecode, end.timecode_sub),
        params=end.param,
    )
    return frame, FrameStamps(end.stamp_camera_mid_exposure, end.stamp_data_received, end.stamp_transmit)


def _body_model(one):
    return StreamedBody(
        one.name,
        one.id_num,
        tuple(marker.name or "" for marker in one.markers),
        tuple(marker.pos for marker in one.markers),
        struct.unpack("<i", struct.pack("<I", one.parent_id))[0],
        one.pos,
    )


def models_of(found):
    """Return the witness's descriptions; it sorts them by their kind."""
    return [
        *(_body_model(one) for one in found.rigid_bodies),
        *(StreamedSet(one.name, one.marker_names) for one in found.marker_sets),
        *(
            StreamedSkeleton(one.name, one.id_num, tuple(map(_body_model, one.rigid_body_descriptions)))
            for one in found.skeletons
        ),
    ]


def datagrams(path):
    """Yield (source port, payload) of the UDP datagrams in a pcapng file of Ethernet frames."""
    data, at = path.read_bytes(), 0
    while at < len(data):
        kind, length = struct.unpack_from("<II", data, at)
        if kind == 6:  # enhanced packet block
            (size,) = struct.unpack_from("<I", data, at + 20)
            ip = data[at + 28 + 14 : at + 28 + size]
            head = 4 * (ip[0] & 15)
            if ip[9] == socket_udp():
                source, _, udp = struct.unpack_from(">HHH", ip, head)
                yield source, ip[head + 8 : head + udp]
        at += length


def socket_udp():
    """Return the number of UDP in an IP header."""
    import socket

    return socket.IPPROTO_UDP
