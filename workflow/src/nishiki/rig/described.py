"""Drive home-made devices on a serial line: those described in YAML, and domes of light-emitting diodes.

Of a dome `<3,n>` lights one diode alone, `<0>` none, `<6>` releases a camera on the dome's shutter cable. `<5,ms>` runs
through all diodes and releases at each: it is not used, since such a run can neither be checked frame by frame nor
continued. The dome's computer answers in words, and lights all diodes when it starts.
"""

import re
import time
from contextlib import suppress
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, field_validator

from nishiki.artifacts.declaration import Closed
from nishiki.capture.frames import parse_state
from nishiki.formats.problems import CaptureError
from nishiki.rig import device
from nishiki.rig.axes import expect_in_range, not_homed_error


class DomeSettings(Closed):
    """A dome with the protocol <3,n>."""

    kind: Literal["dome"]
    port: str = Field(description="serial port")
    count: Annotated[int, Field(ge=1, le=1000)] = Field(description="number of lamps")
    first: Annotated[int, Field(ge=0)] = Field(0, description="number that the dome gives to lamp 1")
    settle_s: device.Pause = Field(0.2, description="seconds from the answer until the light is steady")
    baud: device.Baud = Field(9600, description="bits per second")


class Exchange(Closed):
    """One line to a device, and its answer."""

    send: str = Field(description="line to send; {degrees} and {lamp} stand for the angle and the number of the lamp")
    expect: str = Field(min_length=1, description="text that the answer contains; {lamp}: number of the lamp")
    error: str = Field("error", description="text that an answer contains which refuses; upper and lower case alike")
    timeout_s: device.Seconds = Field(device.ANSWER_S, description="seconds to wait for the answer")

    @field_validator("send")
    @classmethod
    def _check_fields(cls, text: str) -> str:
        try:
            text.format(degrees=0.0, lamp=1)
        except (LookupError, ValueError, AttributeError) as error:
            known = "{degrees} and {lamp}, which may have a format as in {degrees:.2f}"
            raise ValueError(f"between braces expected {known} ({error})") from None
        return text


class Line(Closed):
    """The serial line of a home-made device."""

    port: str = Field(description="serial port, such as /dev/serial/by-id/usb-...")
    baud: device.Baud = Field(115200, description="bits per second")
    ending: str = Field("\n", min_length=1, description="what ends a line, in both directions")
    greeting: str = Field("", description="text that the device sends when it starts; empty: it sends none")
    greeting_s: device.Seconds = Field(
        device.GREETING_S, description="seconds to wait for the greeting after the port was opened"
    )


class DescribedLamps(Line):
    """Lamps of a home-made device."""

    count: Annotated[int, Field(ge=1, le=100_000)] = Field(description="number of lamps")
    first: Annotated[int, Field(ge=0)] = Field(1, description="number that the device gives to lamp 1")
    light: Exchange = Field(description="lights {lamp} alone")
    dark: Exchange = Field(description="switches all lamps off")
    settle_s: device.Pause = Field(0.2, description="seconds from the answer until the light is steady")


class DescribedAxis(Line):
    """An axis of a home-made device."""

    move: Exchange = Field(description="turns to {degrees}; the answer comes when the axis stands")
    home: Exchange | None = Field(
        None,
        description="finds the reference; where it is left out, a person is asked to turn the axis to its zero mark",
    )
    range_deg: tuple[float, float] = Field((0.0, 360.0), description="smallest and largest angle")


def check_state(name: object) -> str:
    """Return the canonical name of a polariser state, or of an angle. ValueError where frames.csv knows none such."""
    try:
        return parse_state(str(name)).name
    except CaptureError as error:
        raise ValueError(str(error)) from None


State = Annotated[str, BeforeValidator(check_state)]
"""Name of a polariser state; an angle needs no quotes."""


class DescribedPolariser(Line):
    """A polariser on a servo motor."""

    states: dict[State, Exchange] = Field(
        min_length=1, description="what to send for each state, named as in frames.csv"
    )
    settle_s: device.Pause = Field(0.0, description="seconds from the answer until the polariser stands")


class _Device:
    """Base of home-made devices: the open line, and exchanges over it."""

    def __init__(self, name: str, line: Line) -> None:
        self.name = name
        greeting = re.escape(line.greeting)
        self.line = device.SerialLine(name, line.port, line.baud, line.ending, greeting)
        if greeting:
            with device.closed_on_failure(self.line):
                self.line.greeting(greeting, line.greeting_s)  # not sent by a board that does not restart when opened

    def ask(self, exchange: Exchange, **values: float) -> None:
        refused = rf"(?i){re.escape(exchange.error)}" if exchange.error else ""
        expect = exchange.expect.replace("{lamp}", f"{values.get('lamp', '')}")
        self.line.ask(exchange.send.format(**values), re.escape(expect), exchange.timeout_s, refused)

    def close(self) -> None:
        """Close the line; a second call does nothing."""
        self.line.close()


class HomeMadeLamps(_Device):
    """Lamps of a YAML description."""

    def __init__(self, name: str, settings: DescribedLamps) -> None:
        super().__init__(name, settings)
        self.settings, self.count = settings, settings.count
        with device.closed_on_failure(self.line):
            self.light(None)

    def light(self, lamp: int | None) -> None:
        """Switch on one lamp, numbered from 1, or none."""
        if lamp is None:
            self.ask(self.settings.dark)
        else:
            if not 1 <= lamp <= self.count:
                found = f"expected a lamp from 1 to {self.count}, found {lamp}"
                raise device.DeviceError(f"{self.name}: {found}. Remedy: correct plan or description")
            self.ask(self.settings.light, lamp=lamp - 1 + self.settings.first)
        time.sleep(self.settings.settle_s)

    def close(self) -> None:
        """Switch the lamps off and close the line."""
        if self.line.serial.is_open:
            with suppress(device.DeviceError):  # it has gone
                self.ask(self.settings.dark)
            self.line.close()


class BracketDome(HomeMadeLamps):
    """A dome with the protocol `<3,n>`."""

    def __init__(self, name: str, settings: DomeSettings) -> None:
        shared = {"error": "INCORRECT FUNCTION CALL", "timeout_s": device.ANSWER_S}
        self.shutter = Exchange(send="<6>", expect="Shutter triggered", **shared)
        described = DescribedLamps(
            **settings.model_dump(exclude={"kind"}),
            greeting="RTI-Dome in",
            greeting_s=device.GREETING_S,
            light=Exchange(send="<3,{lamp}>", expect="Single LED turned on, number: {lamp},", **shared),
            dark=Exchange(send="<0>", expect="All lights turned off", **shared),
        )
        super().__init__(name, described)

    def release(self) -> None:
        """Release the camera on the dome's shutter cable."""
        self.ask(self.shutter)


class HomeMadeAxis(_Device):
    """Axis of a YAML description."""

    def __init__(self, name: str, settings: DescribedAxis) -> None:
        super().__init__(name, settings)
        self.settings, self.range_deg = settings, settings.range_deg
        self.homed = False

    def home(self) -> None:
        """Find the reference, or ask a person to turn the axis to its zero mark."""
        self.homed = False
        if self.settings.home is None:
            device.ask_operator(self.name, "turn the axis by hand to its zero mark")
        else:
            self.ask(self.settings.home)
        self.homed = True

    def move_to(self, degrees: float) -> None:
        """Turn to an angle and return when the axis stands."""
        expect_in_range(self.name, degrees, self.settings.range_deg)
        if not self.homed:
            raise not_homed_error(self.name)
        self.homed = False  # unknown while it turns, and after a failure
        self.ask(self.settings.move, degrees=degrees)
        self.homed = True


class HomeMadePolariser(_Device):
    """Polariser of a YAML description."""

    def __init__(self, name: str, settings: DescribedPolariser) -> None:
        super().__init__(name, settings)
        self.settings, self.states = settings, tuple(settings.states)

    def set(self, state: str) -> None:
        """Move the polariser into a state and return when it stands."""
        device.expect_state(self.name, state, self.states)
        self.ask(self.settings.states[state])
        time.sleep(self.settings.settle_s)
