"""Parameters of the sensor imperfections that `sensor` applies; all are off by default."""

from dataclasses import dataclass, fields

from tactile_rt.core.errors import ConfigError

DEAD = ("dead_probability", "dead_row_probability")
LARGEST = 1e6  # of any value: beyond it time stamps and single precision overflow


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """Imperfections of a sensor; 0 switches an effect off.

    Forces are in N, moments in N m, and apply to the channels of that unit. Channels of other
    units are affected only by what concerns whole samples (time stamps, drops) or all channels
    (gain, ``crosstalk_elements``, bandwidth, dead).

    Attributes:
        gain: The calibration error: relative standard deviation of every channel's constant gain.
        crosstalk_channels: The largest share that leaks from one channel of an element to another,
            as a fraction of full scale (1 N, 10 mN m); each share is drawn uniformly from +- this.
        crosstalk_elements: The share of each grid neighbour's reading (up, down, left, right) that
            an element's same channel receives.
        bias_force, bias_moment: The constant offset: standard deviation over channels, N and N m.
        drift_force, drift_moment: The wandering offset: standard deviation at any one time, N and N
            m.
        drift_time_s: The time constant of the drift, s.
        noise_force, noise_moment: The white noise: standard deviation per sample, N and N m.
        flicker_force, flicker_moment: The 1/f noise: square root of its one-sided spectral density
            at 1 Hz, N and N m per root of a hertz. Its Allan deviation is 1.18 of that at every
            averaging time.
        bandwidth_hz: The corner frequency of a first-order low-pass on every channel, Hz.
        hysteresis_force, hysteresis_moment: Half the width of the loop between loading and
            unloading, N and N m: a reading follows its load only once that has moved so far.
        dead_probability: The probability that an element is dead, drawn once. A dead element reads
            its constant bias, 0 by default; its ``valid`` stays True, because a robot does not
            know.
        dead_row_probability: The probability that a whole row of the grid is dead, drawn once.
        resolution_force, resolution_moment: The quantisation step, N and N m; readings round to the
            nearest.
        range_force, range_moment: The largest reading of either sign, where the sensor saturates, N
            and N m; also of rounded readings.
        latency_ms: The time from the sample to its time stamp, which the host gives on receipt, ms.
        jitter_ms: The mean (and standard deviation) of a further, exponentially distributed delay
            of each time stamp, ms. Delays of neighbours are alike where they are long against the
            sample's period, as in a queue: a sample is never received before its predecessor.
        drop_probability: The probability of each sample to be dropped, independently; dropped
            samples leave gaps in ``seq``.

    The drift is a stationary Ornstein-Uhlenbeck process, not a random walk: its spread stays the
    same however long the stream runs.

    Raises:
        ConfigError: a negative value or one beyond a million, a share or probability above 1, a
            drop probability of 1, or a drift time that is not positive.
    """

    gain: float = 0.0
    crosstalk_channels: float = 0.0
    crosstalk_elements: float = 0.0
    bias_force: float = 0.0
    bias_moment: float = 0.0
    drift_force: float = 0.0
    drift_moment: float = 0.0
    drift_time_s: float = 60.0
    noise_force: float = 0.0
    noise_moment: float = 0.0
    flicker_force: float = 0.0
    flicker_moment: float = 0.0
    bandwidth_hz: float = 0.0
    hysteresis_force: float = 0.0
    hysteresis_moment: float = 0.0
    dead_probability: float = 0.0
    dead_row_probability: float = 0.0
    range_force: float = 0.0
    range_moment: float = 0.0
    resolution_force: float = 0.0
    resolution_moment: float = 0.0
    latency_ms: float = 0.0
    jitter_ms: float = 0.0
    drop_probability: float = 0.0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(SensorModel)):
            value = getattr(self, name)
            if not 0 <= value <= LARGEST:
                bound = f"at most {LARGEST:g}" if value > 0 else "0 or more"
                raise ConfigError(f"{name} must be {bound}, not {value}")
        for name in ("crosstalk_channels", "crosstalk_elements", *DEAD):
            if getattr(self, name) > 1:
                raise ConfigError(f"{name} must lie between 0 and 1, not {getattr(self, name)}")
        if self.drop_probability >= 1:
            raise ConfigError(f"drop_probability must be less than 1, not {self.drop_probability}")
        if self.drift_time_s == 0:
            raise ConfigError("drift_time_s must be more than 0")
