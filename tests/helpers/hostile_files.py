"""Files that are made to hang or exhaust who reads them; each is small, or made in a moment."""

import base64
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable

GIB = 1 << 30

# MCAP: a recording's beginning, as ours are written, and then what none has


def _record(opcode: int, data: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(data)) + data


def _string(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def _message(count: int, data: bytes = b"", channel: int = 1) -> bytes:
    return _record(5, struct.pack("<HIQQ", channel, count, 0, 0) + data)


def _chunk(compression: bytes, packed: bytes, size: int, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 0, size, crc) + _string(compression)
    return _record(6, head + struct.pack("<Q", len(packed)) + packed)


def _recording(*records: bytes) -> bytes:
    from tactile_rt.recording import Description
    from tactile_rt.recording.reader import MAGIC
    from tactile_rt.recording.writer import McapFile
    from tests.helpers.recordings import SPEC

    begun = io.BytesIO()
    McapFile(begun, Description(SPEC, 1_700_000_000 * 10**9)).flush()
    end = _record(15, bytes(4)) + _record(2, bytes(20)) + MAGIC
    return begun.getvalue() + b"".join(records) + end


def _zeros(size: int, piece: int = 1 << 24) -> Iterable[bytes]:
    return (bytes(min(piece, size - at)) for at in range(0, size, piece))


def _zstd(size: int, told: bool = True) -> bytes:
    import zstandard

    packer = zstandard.ZstdCompressor(level=1).compressobj(size=size if told else -1)
    return b"".join([*map(packer.compress, _zeros(size)), packer.flush()])


def _lz4(size: int) -> bytes:
    import lz4.frame

    with lz4.frame.LZ4FrameCompressor() as packer:
        return b"".join([packer.begin(), *map(packer.compress, _zeros(size)), packer.flush()])


def _tiny(number: int) -> bytes:
    data = b"".join(_message(i) for i in range(number))
    return _chunk(b"", data, len(data), zlib.crc32(data))


def _many_bombs() -> bytes:
    size = 32 << 20
    return _chunk(b"zstd", _zstd(size), size) * 300


MCAPS: dict[str, Callable[[], bytes]] = {
    "zstd of 1 GiB": lambda: _recording(_chunk(b"zstd", _zstd(GIB), GIB)),
    "zstd of untold size": lambda: _recording(_chunk(b"zstd", _zstd(GIB, False), 1 << 20)),
    "lz4 of 1 GiB": lambda: _recording(_chunk(b"lz4", _lz4(GIB), GIB)),
    "a size that lies": lambda: _recording(_chunk(b"zstd", _zstd(GIB), 1000)),
    "hundreds of bombs": lambda: _recording(_many_bombs()),
    "a million tiny messages": lambda: _recording(_tiny(1_000_000)),
    "a million schemas": lambda: _recording(_record(3, bytes(14)) * 1_000_000),
    "a million attachments": lambda: _recording(_record(9, bytes(36)) * 1_000_000),
    "a million notes": lambda: _recording(
        _record(12, _string(b"tactile_rt") + _string(b"")) * 1_000_000
    ),
    "a huge length": lambda: _recording(struct.pack("<BQ", 6, 1 << 62), bytes(100)),
    "a chunk in a chunk": lambda: _recording(
        _chunk(b"", inner := _chunk(b"", _message(0), 1 << 40), len(inner))
    ),
    "a huge index": lambda: _recording(
        _record(7, struct.pack("<HI", 1, 60_000_000) + bytes(60_000_000)), _message(7)
    ),
    "an index that points back": lambda: _recording(
        _record(8, struct.pack("<4Q", 0, 0, 8, 1 << 40) + struct.pack("<I", 10) + bytes(10)),
        _chunk(b"zstd", _zstd(GIB), 1 << 35),
    ),
    "cut in a bomb": lambda: _recording(_chunk(b"zstd", _zstd(GIB), GIB))[:20_000],
}

# DBC: what a sensor's bus looks like, and then what no bus has


def _dbc(text: str, length: str = "8") -> bytes:
    return f'VERSION ""\nBU_: A\nBO_ 1 M: {length} A\n{text}\n'.encode("cp1252")


def _signals(number: int) -> str:
    return "\n".join(f' SG_ S{i} : {i % 64}|1@1+ (1,0) [0|1] "" A' for i in range(number))


def _message_per_line(number: int) -> str:
    return "\n".join(f"BO_ {i + (1 << 31)} M{i}: 64 A" for i in range(number))


def _nested(depth: int) -> str:
    head = ' SG_ S0 M : 0|8@1+ (1,0) [0|1] "" A\n'
    lines = (f' SG_ S{i} m0M : {i % 56}|8@1+ (1,0) [0|1] "" A' for i in range(1, depth))
    ranges = (f"SG_MUL_VAL_ 1 S{i} S{i - 1} 0-0;" for i in range(1, depth))
    return head + "\n".join([*lines, "", *ranges])


MUX = ' SG_ X M : 0|8@1+ (1,0) [0|1] "" A\n SG_ S m0 : 8|8@1+ (1,0) [0|1] "" A\n'
DBCS: dict[str, Callable[[], bytes]] = {
    "a message of 100,000 bytes": lambda: _dbc(_signals(1), "100000"),
    "a length of 10,000 digits": lambda: _dbc(_signals(1), "9" * 10_000),
    "100 MB": lambda: _dbc(_signals(1)) + b" " * 100_000_000,
    "a million signals": lambda: _dbc(_signals(1_000_000)),
    "a signal of 10^9 bits": lambda: _dbc(' SG_ S : 0|1000000000@1+ (1,0) [0|1] "" A'),
    "a signal at bit 10^9": lambda: _dbc(' SG_ S : 1000000000|8@1+ (1,0) [0|1] "" A'),
    "a multiplexer of 10^9 values": lambda: _dbc(MUX + "SG_MUL_VAL_ 1 S X 0-1000000000;"),
    "a thousand multiplexers deep": lambda: _dbc(_nested(1000)),
    "multiplexers in a circle": lambda: _dbc(
        ' SG_ S m0M : 0|8@1+ (1,0) [0|1] "" A\n SG_ T m0M : 8|8@1+ (1,0) [0|1] "" A\n'
        "SG_MUL_VAL_ 1 S T 0-0;\nSG_MUL_VAL_ 1 T S 0-0;"
    ),
    "a string without end": lambda: _dbc(_signals(1) + '\nCM_ "' + '\\"' * 400_000),
    "a million quotes": lambda: _dbc(_signals(1) + "\nCM_ " + '"a"\\' * 200_000),
    "no end of names": lambda: _dbc(" SG_ " + "a " * 500_000),
    "zeroes": lambda: bytes(1 << 20),
    "25,000 messages": lambda: _dbc(_message_per_line(25_000)),
    "a name of 1 MB": lambda: _dbc(f' SG_ {"a" * 1_000_000} : 0|8@1+ (1,0) [0|1] "" A'),
}


# Meshes: a name with its ending, and what is in the file


def _zipped(members: Iterable[tuple[str, Iterable[bytes]]]) -> bytes:
    """A ZIP archive, deflated."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, parts in members:
            with archive.open(name, "w", force_zip64=True) as member:
                for part in parts:
                    member.write(part)
    return packed.getvalue()


def _ply(kind: str, vertices: int, faces: int, body: bytes, list_of: str = "uchar") -> bytes:
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {vertices}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list {list_of} int vertex_indices\nend_header\n"
    )
    return head.encode() + body


def _3mf(model: str) -> bytes:
    head = (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<model unit="millimeter" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
    )
    return _zipped([("3D/3dmodel.model", [(head + model + "</model>").encode()])])


def _3mf_instances(depth: int, each: int) -> str:
    """Each object holds the one before several times: each^depth tetrahedra."""
    mesh = (
        '<object id="1" type="model"><mesh><vertices><vertex x="0" y="0" z="0"/>'
        '<vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/><vertex x="0" y="0" z="1"/>'
        '</vertices><triangles><triangle v1="0" v2="2" v3="1"/><triangle v1="0" v2="1" v3="3"/>'
        '<triangle v1="1" v2="2" v3="3"/><triangle v1="2" v2="0" v3="3"/></triangles></mesh>'
        "</object>"
    )
    shift = "1 0 0 0 1 0 0 0 1 {} 0 0"
    for i in range(2, depth + 2):
        held = "".join(
            f'<component objectid="{i - 1}" transform="{shift.format(2 * k)}"/>'
            for k in range(each)
        )
        mesh += f'<object id="{i}" type="model"><components>{held}</components></object>'
    return f'<resources>{mesh}</resources><build><item objectid="{depth + 1}"/></build>'


def _dae(doctype: str, text: str) -> bytes:
    return (
        f'<?xml version="1.0"?>{doctype}'
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        f"{text}</COLLADA>"
    ).encode()


def _laughs() -> bytes:
    entities = ['<!ENTITY a0 "ha ha ha ha ha">']
    entities += [f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12)]
    title = "<asset><title>&a11;</title></asset>"
    return _dae(f"<!DOCTYPE COLLADA [{''.join(entities)}]>", title)


def _dae_nodes(depth: int) -> bytes:
    """Nodes that hold the one before twice: 2^depth."""
    nodes = '<node id="n0"/>' + "".join(
        f'<node id="n{i}">{f"""<instance_node url="#n{i - 1}"/>""" * 2}</node>'
        for i in range(1, depth)
    )
    scene = f'<visual_scene id="s"><node id="r"><instance_node url="#n{depth - 1}"/></node>'
    return _dae(
        "",
        "<asset><unit meter='1'/></asset>"
        f"<library_nodes>{nodes}</library_nodes>"
        f"<library_visual_scenes>{scene}</visual_scene></library_visual_scenes>"
        '<scene><instance_visual_scene url="#s"/></scene>',
    )


def _gltf(**parts: object) -> bytes:
    whole = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], **parts}
    return json.dumps(whole).encode()


def _gltf_of(count: int, buffer: dict[str, object], **accessor: object) -> dict[str, object]:
    data = {"componentType": 5126, "type": "VEC3", "count": count, "bufferView": 0, **accessor}
    return {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{k: v for k, v in data.items() if v is not None}],
        "bufferViews": [{"buffer": 0, "byteLength": 12 * count}],
        "buffers": [buffer],
    }


def _data_uri(data: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(data).decode()


def _gltf_instances(nodes: int, triangles: int) -> bytes:
    """A mesh of so many triangles, by so many nodes."""
    corners = b"".join(struct.pack("<3f", i % 7, i % 11, i % 13) for i in range(3 * triangles))
    made = _gltf_of(3 * triangles, {"byteLength": len(corners), "uri": _data_uri(corners)})
    made["nodes"] = [{"mesh": 0}] * nodes
    return _gltf(**made, scenes=[{"nodes": list(range(nodes))}])


def _draco(points: int) -> dict[str, object]:
    # header of a mesh, sequential: this many faces and points, and no data
    data = b"DRACO" + bytes([2, 2, 1, 0, 0, 0]) + b"\xff\xff\xff\xff\x0f" * 2
    made = _gltf_of(points, {"byteLength": len(data), "uri": _data_uri(data)}, bufferView=None)
    extension = {"bufferView": 0, "attributes": {"POSITION": 0}}
    primitive = {"attributes": {"POSITION": 0}}
    primitive["extensions"] = {"KHR_draco_mesh_compression": extension}
    made["meshes"] = [{"primitives": [primitive]}]
    made["bufferViews"] = [{"buffer": 0, "byteLength": len(data)}]
    made["extensionsUsed"] = made["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    return made


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
MESHES: dict[str, Callable[[], tuple[str, bytes]]] = {
    "STL of 4e9 faces": lambda: (".stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(500)),
    "PLY of 10^9 vertices": lambda: (".ply", _ply("binary_little_endian", 10**9, 1, bytes(100))),
    "text PLY of 10^9 faces": lambda: (".ply", _ply("ascii", 3, 10**9, b"0 0 0\n" * 3)),
    "PLY list of 2^31": lambda: (
        ".ply",
        _ply("binary_little_endian", 3, 9, bytes(36) + b"\xff\xff\xff\x7f" + bytes(99), "uint"),
    ),
    "OBJ of index 2^31": lambda: (".obj", (TETRAHEDRON + "f 1 2 2147483647\n").encode()),
    "OBJ of index -2^62": lambda: (".obj", (TETRAHEDRON + f"f 1 2 {-(1 << 62)}\n").encode()),
    "OBJ of a face of 10^6": lambda: (".obj", ("v 0 0 0\nf" + " 1" * 1_000_000).encode()),
    "OFF of 10^9 vertices": lambda: (".off", b"OFF\n1000000000 1000000000 0\n0 0 0\n"),
    "ZIP of 1 GiB": lambda: (".3mf", _zipped([("3D/3dmodel.model", _zeros(GIB))])),
    "3MF of 8^12 instances": lambda: (".3mf", _3mf(_3mf_instances(12, 8))),
    "3MF in a circle": lambda: (
        ".3mf",
        _3mf(
            '<resources><object id="1"><components><component objectid="1"/></components>'
            '</object></resources><build><item objectid="1"/></build>'
        ),
    ),
    "a billion laughs": lambda: (".dae", _laughs()),
    "COLLADA of 2^40 nodes": lambda: (".dae", _dae_nodes(40)),
    "XML a million deep": lambda: (".dae", _dae("", "<node>" * 1_000_000)),
    "glTF buffer of 10^12": lambda: (
        ".gltf",
        _gltf(**_gltf_of(10**11, {"byteLength": 12 * 10**11, "uri": _data_uri(bytes(36))})),
    ),
    "glTF accessor of nothing": lambda: (
        ".gltf",
        _gltf(**_gltf_of(10**9, {"byteLength": 36, "uri": _data_uri(bytes(36))}, bufferView=None)),
    ),
    "glTF of 2e9 instances": lambda: (".gltf", _gltf_instances(20_000, 10_000)),
    "glTF a million nodes deep": lambda: (
        ".gltf",
        _gltf(nodes=[{"children": [i + 1]} for i in range(200_000)] + [{}]),
    ),
    "glTF of Draco's 10^9": lambda: (".gltf", _gltf(**_draco(10**9))),
    "GLB of 4 GB": lambda: (
        ".glb",
        b"glTF" + struct.pack("<III", 2, 0xFFFFFFFF, 0xFFFFFFF0) + b"JSON" + b"{" * 100,
    ),
    "JSON a million deep": lambda: (".gltf", b'{"asset":' + b"[" * 1_000_000),
}
