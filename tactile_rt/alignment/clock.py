"""Check of the clock of spikes: rates must rise 3 to 40 ms after contact.

Barrel cortex responds to a touch within milliseconds, so the recording itself shows whether its
spikes and its contacts are on one clock.

- *Contacts* count only if they begin a bout, without a contact in the 250 ms before: the rate
  before is then a baseline, and the rhythm of whisking cannot make another shift look right.
- *The rise* is the number of spikes 3 to 40 ms after contact, minus that in an equal time before.
- *Chance* is measured by shifting spikes against contacts by up to 20 s, or somewhat more than the
  recording's starting time: z is the rise in units of the spread of the rises over all shifts. Slow
  changes of the rate, such as with the trials, cancel in the difference.
- *Another clock* is suspected if another shift has a rise that is beyond chance and clearly greater
  than the rise without a shift.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.rdm import Floats

CLOCKS = ("session", "recording")  # as in NWB; shifted by the starting time, as published
WARNING = "WARNING: "  # prefix of notes that the user must read

APART_S = 0.25  # least time between a contact that counts and the previous one
RISE_MS = (3, 40)
BEFORE_MS, AFTER_MS = 40, 60  # extent of the histogram before and after contact
BEFORE = slice(BEFORE_MS - RISE_MS[1], BEFORE_MS - RISE_MS[0])  # parts of it that are compared
AFTER = slice(BEFORE_MS + RISE_MS[0], BEFORE_MS + RISE_MS[1])
BIN_S = 0.002  # bin width in the search for another shift
HERE_S = 0.03  # a shift up to this counts as none
SEARCH_S, FURTHER_S = 20.0, 5.0  # least reach of the search, and reach beyond the starting time
FURTHEST_S, LONGEST_S = 600.0, 14_400.0  # greatest reach, and longest session that is searched
RISES_Z = 5.0  # least z of a rise beyond chance
ELSEWHERE_Z, CLEARLY = 7.0, 1.5  # least z of another clock, also as a multiple of z without shift


@dataclass(frozen=True, eq=False)
class ContactResponse:
    """The change of firing rates with contact, measured in one session or several."""

    session: str
    shift_s: float  # shift that was subtracted from the stored spike times, in s
    # (100,) number of spikes of all units in each ms from 40 ms before to 60 ms after contact
    histogram: NDArray[np.int64]
    windows: int  # number of contacts times the number of units
    rise: float  # number of spikes 3 to 40 ms after contact, minus that in an equal time before
    spread: float  # standard deviation of the rise over other shifts, by chance alone
    # shift in s to subtract from the stored spike times: the best one other than `shift_s`
    other_s: float = 0.0
    other_z: float = 0.0  # rise at that shift, in units of `spread`

    @property
    def z(self) -> float:
        """Rise divided by its standard deviation by chance; 0 if that is 0."""
        return self.rise / self.spread if self.spread > 0 else 0.0

    @property
    def rises(self) -> bool:
        """True if the rates rise after contact, beyond chance."""
        return self.z >= RISES_Z

    @property
    def elsewhere(self) -> bool:
        """True if another shift of spike times fits the contacts clearly better."""
        return self.other_z >= max(ELSEWHERE_Z, CLEARLY * self.z)

    @property
    def latency_s(self) -> float:
        """Time from contact until the rate is half way from baseline to peak, in s."""
        smooth = np.convolve(self.histogram, np.ones(3) / 3, mode="same")
        base, after = smooth[1:BEFORE_MS].mean(), smooth[BEFORE_MS:-1]
        return float(np.argmax(after >= (base + after.max()) / 2) + 0.5) * 1e-3

    def rate_hz(self, part: slice) -> float:
        """Return the mean rate per unit in a part of the histogram, spikes/s."""
        time_s = self.windows * (part.stop - part.start) * 1e-3
        return float(self.histogram[part].sum() / time_s) if time_s else 0.0


def contact_response(
    session: str,
    spikes: Sequence[Floats],
    contacts: Floats,
    shift_s: float = 0.0,
    starting_time_s: float = 0.0,
) -> ContactResponse | None:
    """Measure the change of a session's firing rates with contact.

    Args:
        spikes: (spike,) stored times of each unit in s, finite.
        contacts: (contact,) start times of contacts in s, finite and sorted.
        shift_s: shift to subtract from the stored times.
        starting_time_s: starting time of the electrical recording; the search reaches beyond it.

    Returns:
        The response; None without contacts or spikes, or if contacts span more than 4 hours.
    """
    first = contacts[np.diff(contacts, prepend=-np.inf) > APART_S]
    times = np.sort(np.concatenate([*spikes, np.empty(0)])) - shift_s
    reach = min(max(SEARCH_S, abs(starting_time_s) + FURTHER_S), FURTHEST_S)
    if not first.size or first[-1] - first[0] > LONGEST_S:
        return None
    times = times[(times > first[0] - 2 * reach) & (times < first[-1] + 2 * reach)]
    if not times.size:
        return None
    edges_s = np.arange(-BEFORE_MS, AFTER_MS + 1) * 1e-3
    # A microsecond less, since times stored in s may lie beside a bin's edge by rounding.
    before = np.searchsorted(times, first[:, None] + edges_s - 1e-6)  # spikes before each edge
    histogram = np.diff(before.sum(axis=0))
    shifts, rises = _search_shifts(times, first, reach)
    low, high = np.percentile(rises, (2.5, 97.5))  # a true rise covers too few shifts to matter
    spread = float(high - low) / 3.92
    far = np.abs(shifts) > HERE_S
    best = int(np.argmax(np.where(far, rises, -np.inf)))
    return ContactResponse(
        session=session,
        shift_s=shift_s,
        histogram=histogram,
        windows=len(first) * len(spikes),
        rise=float(histogram[AFTER].sum() - histogram[BEFORE].sum()),
        spread=spread,
        other_s=float(shifts[best]) + shift_s,
        other_z=float(rises[best]) / spread if spread > 0 else 0.0,
    )


def _search_shifts(times: Floats, contacts: Floats, reach: float) -> tuple[Floats, Floats]:
    """Compute the rise after contact for each shift (s) subtracted from spike times."""
    begin = contacts[0] - 2 * reach
    bins = int((contacts[-1] - contacts[0] + 4 * reach) / BIN_S) + 2

    def count(values: Floats) -> NDArray[np.int64]:
        return np.bincount(((values - begin) / BIN_S).astype(np.int64), minlength=bins)[:bins]

    size = 1 << (bins - 1).bit_length()
    product = np.conj(np.fft.rfft(count(contacts), size)) * np.fft.rfft(count(times), size)
    together = np.fft.irfft(product, size)  # at k: number of spikes k bins after a contact
    window = round(RISE_MS[1] * 1e-3 / BIN_S)
    lags = np.arange(-int(reach / BIN_S), int(reach / BIN_S) + 1)
    total = np.concatenate([[0.0], np.cumsum(np.roll(together, size // 2))])
    at = lags + size // 2
    rises = (total[at + window + 1] - total[at + 1]) - (total[at] - total[at - window])
    return np.asarray(lags * BIN_S, dtype=np.float64), np.asarray(rises, dtype=np.float64)


def said_of(responses: Sequence[ContactResponse], clock: str) -> str:
    """Format responses as one line: clock, rates before and after contact, latency, effect."""
    whole = ContactResponse(
        session="all",
        shift_s=0.0,
        histogram=np.sum([r.histogram for r in responses], axis=0),
        windows=sum(r.windows for r in responses),
        rise=sum(r.rise for r in responses),
        spread=float(np.sqrt(sum(r.spread**2 for r in responses))),
    )
    shifts = [r.shift_s for r in responses]
    where = "spikes on the session's clock (offset 0 s)"
    if clock == "recording":
        where = f"spikes shifted by the starting time ({_format_range(shifts)} s), as published"
    before, after = whole.rate_hz(BEFORE), whole.rate_hz(AFTER)
    figures = f"{before:.2f} spikes/s before contact, {after:.2f} in the 3-40 ms after it"
    if not whole.rises:
        return f"{WARNING}{where}: rates do not rise after contact: {figures} (z = {whole.z:.1f})"
    rising = sum(r.rises for r in responses)
    more = f" ({after / before - 1:+.0%})" if before else ""
    return (
        f"{where}: {figures}{more}, z = {whole.z:.1f}, latency {whole.latency_s * 1e3:.1f} ms; "
        f"they rise in {rising} of {len(responses)} sessions"
    )


def _format_range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.2f}" if low == high else f"{low:.2f} to {high:.2f}"
