"""The places where a whisker is nearest to an object's pieces: the contacts of a step."""

import math
from typing import Any, NamedTuple

import numpy as np

from tactile_rt.sim_backend.rods.chains import Pose
from tactile_rt.sim_backend.rods.compiled import compile_cached
from tactile_rt.sim_backend.rods.nearest import WORK, nearest

A = Any
NEAR_MM = 0.1  # places that are nearer are constraints of a step
STALE_MM, CLOSE_MM = 0.05, 1.0  # a plane closer than CLOSE_MM is updated after STALE_MM of travel
MOST_CONTACTS = 8  # of one whisker at one time: the nearest ones


class Segments(NamedTuple):
    """The segments of a whisker that are searched for contacts with an object.

    The search runs along a segment's chord; the arc's distance from the chord is approximated by a
    parabola.

    Attributes:
        link: (segment,) numbers of the segments' links.
        ends: (segment, 2, 3) both ends, in the link's frame, mm.
        bows: (segment, 3) vectors from the middle of the chord to the resting curve, in the link's
            frame, mm.
        radii, arcs: (segment, 2) radii and arc lengths from the base at the ends, mm.
    """

    link: A
    ends: A
    bows: A
    radii: A
    arcs: A


class Object(NamedTuple):
    """The convex pieces of an object, concatenated, relative to the object's position.

    Attributes:
        corners: (corner, 3) corners of the pieces, mm.
        corner_at: (piece + 1,) index of each piece's first corner.
        faces: (face, 4) outward normals and offsets.
        face_at: (piece + 1,) index of each piece's first face.
        rounding: (piece,) the radius by which each piece is grown, mm.
        beside: The neighbours of each corner along its edges, numbered in its piece, see
            `nearest`; none for pieces with few corners.
        beside_at: (corner + 1,) index of each corner's first neighbour in `beside`.
    """

    corners: A
    corner_at: A
    faces: A
    face_at: A
    rounding: A
    beside: A
    beside_at: A


class Seen(NamedTuple):
    """Cached bounds of the gaps between a whisker and an object; updated by every search.

    Attributes:
        travelled: (1,) the distance that object and whisker have travelled since the start, mm.
        reach: (segment, piece) lower bound of the gap, plus `travelled` when it was computed.
        soonest: (piece + 1,) the least `reach` over segments, and infinity at the end.
        known: (segment, piece, 4) initial pairs of points for the search, see `nearest`.
        planes: (segment, piece, 5) outward normal and offset of a plane that the piece does not
            cross, and `travelled` when it was computed.
    """

    travelled: A
    reach: A
    soonest: A
    known: A
    planes: A


class Contacts(NamedTuple):
    """Places where a whisker is near an object, up to `MOST_CONTACTS`.

    Attributes:
        gaps: (contact,) gaps between the surfaces, mm.
        normals: (contact, 3) directions from the piece to the whisker, in the world.
        points: (contact, 3) points of the whisker's surface, in the world, mm.
        segments, places: (contact,) the segment, and the place on it from 0 to 1.
    """

    gaps: A
    normals: A
    points: A
    segments: A
    places: A


def unseen(whiskers: int, segments: int, pieces: int) -> Seen:
    """Return the initial bounds of several whiskers, their segments concatenated."""
    return Seen(
        np.zeros((whiskers, 1)),
        np.full((segments, pieces), -np.inf),
        np.array([[-np.inf] * pieces + [np.inf]] * whiskers),
        np.full((segments, pieces, 4), -1),
        np.tile([0.0, 0.0, 0.0, np.inf, 0.0], (segments, pieces, 1)),
    )


@compile_cached
def forget(seen: Seen) -> None:
    """Reset all bounds to those before the first search."""
    seen.reach[:] = -np.inf
    seen.soonest[:-1] = -np.inf
    seen.known[:] = -1
    seen.planes[:, :, :3] = 0.0
    seen.planes[:, :, 3] = np.inf
    seen.planes[:, :, 4] = seen.travelled[0]


@compile_cached
def find_near(
    pose: Pose,
    segments: Segments,
    thing: Object,
    centre: A,
    within: float,
    seen: Seen,
    ends: A,
    now: A,
    near: Contacts,
) -> int:
    """Find the places where a whisker is nearest to pieces, and return their number.

    For each piece these are the minima of the gap along each link. A plane that a piece does not
    cross bounds the gap of a segment from below. As pieces do not rotate, the last search's plane
    remains valid: only segments whose bound is less than their neighbours' are searched again.

    Args:
        centre: (3,) position of the object, mm.
        within: gap below which segments are searched: `NEAR_MM`, or more for longer-lived bounds.
        ends: (segment, 2, 3) scratch.
        now: (segment, 6) scratch: gap, place, direction, and whether the gap is more than a bound.
        near: filled.
    """
    travelled = seen.travelled[0]
    reach, planes = seen.reach, seen.planes
    radii, rounding = segments.radii, thing.rounding
    corner_at, face_at = thing.corner_at, thing.face_at
    count, number = 0, len(segments.link)
    found, scratch = np.empty(6), np.empty(WORK)
    for s in range(number):
        ends[s, 0, 0] = np.inf  # not yet computed
    for p in range(len(rounding)):
        if seen.soonest[p] - travelled >= within:
            continue
        first, last = number, -1
        for s in range(number):
            now[s, 0] = np.inf
            if reach[s, p] - travelled >= within:
                continue
            if ends[s, 0, 0] == np.inf:
                link = segments.link[s]
                _place_ends(segments.ends[s], pose.nodes[link], pose.frames[link], centre, ends[s])
            bow = 0.0
            for i in range(3):
                bow += segments.bows[s, i] ** 2
            bow, bound = math.sqrt(bow), np.inf
            for end in range(2):
                ahead = -planes[s, p, 3] - rounding[p] - radii[s, end] - bow
                for i in range(3):
                    ahead += planes[s, p, i] * ends[s, end, i]
                bound = min(bound, ahead)
            if travelled - planes[s, p, 4] > STALE_MM and bound < CLOSE_MM:
                bound = -np.inf
            reach[s, p] = bound + travelled
            if bound < within:
                now[s, 0], now[s, 5] = bound, 0.0
                first, last = min(first, s), s
        again = last >= 0
        while again:
            again = False
            for s in range(first, last + 1):
                if now[s, 0] == np.inf or now[s, 5] or not _is_nearest(s, now, segments.link):
                    continue
                nearest(
                    ends[s, 0],
                    ends[s, 1],
                    thing.corners[corner_at[p] : corner_at[p + 1]],
                    thing.faces[face_at[p] : face_at[p + 1]],
                    thing.beside,
                    thing.beside_at[corner_at[p] : corner_at[p + 1] + 1],
                    seen.known[s, p],
                    scratch,
                    found,
                )
                t, frame = found[1], pose.frames[segments.link[s]]
                gap = found[0] - rounding[p] - radii[s, 0] * (1 - t) - radii[s, 1] * t
                for i in range(3):
                    for k in range(3):
                        gap += found[2 + i] * frame[i, k] * segments.bows[s, k] * 4 * t * (1 - t)
                reach[s, p] = gap + travelled
                planes[s, p, 3], planes[s, p, 4] = found[5], travelled
                for i in range(3):
                    planes[s, p, i] = now[s, 2 + i] = found[2 + i]
                now[s, 0], now[s, 1], now[s, 5] = gap, t, 1.0
                if gap >= NEAR_MM:
                    now[s, 0] = np.inf
                again = True
        seen.soonest[p] = np.inf
        for s in range(number):
            seen.soonest[p] = min(seen.soonest[p], reach[s, p])
        for s in range(first, last + 1):
            gap = now[s, 0]
            if gap == np.inf or not _is_nearest(s, now, segments.link):
                continue
            # Segments on adjacent links share an end: count a minimum there once.
            if s > 0 and now[s, 1] == 0.0 and now[s - 1, 0] <= gap and now[s - 1, 5]:
                if now[s - 1, 1] == 1.0:
                    continue
            slot = count
            if count == MOST_CONTACTS:
                slot = int(np.argmax(near.gaps))
                if near.gaps[slot] <= gap:
                    continue
            else:
                count += 1
            t, link = now[s, 1], segments.link[s]
            radius = radii[s, 0] * (1 - t) + radii[s, 1] * t
            near.gaps[slot], near.segments[slot], near.places[slot] = gap, s, t
            for i in range(3):
                near.normals[slot, i] = now[s, 2 + i]
                near.points[slot, i] = pose.nodes[link, i] - now[s, 2 + i] * radius
                for k in range(3):
                    at = segments.ends[s, 0, k] * (1 - t) + segments.ends[s, 1, k] * t
                    at += segments.bows[s, k] * 4 * t * (1 - t)
                    near.points[slot, i] += pose.frames[link, i, k] * at
    return count


@compile_cached
def _is_nearest(s: int, now: A, link_of: A) -> bool:
    """Return whether segment `s` is nearer than its neighbours on the link, by present bounds."""
    gap, link = now[s, 0], link_of[s]
    if s > 0 and link_of[s - 1] == link and now[s - 1, 0] <= gap:
        return False
    return not (s + 1 < len(link_of) and link_of[s + 1] == link and now[s + 1, 0] < gap)


@compile_cached
def _place_ends(in_link: A, node: A, frame: A, centre: A, ends: A) -> None:
    """Compute the (2, 3) ends of a segment relative to the object's position."""
    for end in range(2):
        for i in range(3):
            ends[end, i] = node[i] - centre[i]
            for k in range(3):
                ends[end, i] += frame[i, k] * in_link[end, k]
