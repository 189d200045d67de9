"""Registry of device makes: one line per make in ``MAKES``, then the makes of installed packages.

A make is a folder of this package. Its driver, its emulator and its protocol signatures are loaded
by name when they are needed, so that the real-time process loads neither emulators nor OpenCV. An
installed package offers a driver as ``name = "module:callable"`` under the entry points
``touchdown.<kind>``. A shipped driver cannot be replaced.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Literal

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import InputError, errors_as_input

DeviceKind = Literal["force_torque", "gripper", "arm", "tactile"]


@dataclass(frozen=True, slots=True)
class Make:
    """One make of device in the folder ``backend/devices/<name>``.

    Parameters
    ----------
    kind
        Kind of device. It fixes the arguments of ``driver``, see ``factories``.
    name
        Name of the folder, and of the driver in lab files.
    driver
        Callable that returns the driver, in ``driver.py`` or given as ``"module:name"``.
    emulator
        Callable ``(choice, faults) -> Emulation`` in ``emulator.py``, empty if there is none.
    signatures
        Sequence of ``ProtocolSignature`` in ``protocol.py`` or given as ``"module:name"``, empty if
        the device cannot be identified by its bytes.
    emulated_as
        Name for ``touchdown emulate`` where one folder holds two kinds of device.

    """

    kind: DeviceKind
    name: str
    driver: str
    emulator: str = ""
    signatures: str = ""
    emulated_as: str = ""

    def load_driver(self) -> Any:
        """Return the callable that returns the driver."""
        return self._load("driver", self.driver)

    def load_emulator(self) -> Any:
        """Return the callable that returns the emulation."""
        return self._load("emulator", self.emulator)

    def load_signatures(self) -> Any:
        """Return the protocol signatures, empty if there are none."""
        return self._load("protocol", self.signatures) if self.signatures else ()

    def _load(self, module: str, place: str) -> Any:
        given, _, name = place.rpartition(":")
        return getattr(
            importlib.import_module(f"{__package__}.{self.name}.{given or module}"), name
        )


MAKES: tuple[Make, ...] = (
    Make("gripper", "wsg", "make_wsg", "emulate_wsg", "gcl:SIGNATURES"),
    Make("force_torque", "dynpick", "DynpickDriver", "emulate_dynpick", "SIGNATURES"),
    Make("force_torque", "leptrino", "LeptrinoDriver", "emulate_leptrino", "SIGNATURES"),
    Make("force_torque", "ft300", "Ft300Driver", "emulate_ft300", "SIGNATURES"),
    Make("force_torque", "bota", "BotaDriver", "emulate_bota", "SIGNATURES"),
    Make("force_torque", "optoforce", "OptoforceDriver", "emulate_optoforce", "SIGNATURES"),
    Make("force_torque", "netft", "NetFtDriver", "emulate_netft"),
    Make(
        "force_torque",
        "melfa",
        "wrist_sensor:MelfaWrenchDriver",
        "emulate_monitor",
        emulated_as="monitor",
    ),
    Make("force_torque", "ur", "rtde:UrWrenchDriver"),
    Make("arm", "melfa", "make_melfa", "emulate_melfa"),
    Make("arm", "ur", "UrArm"),
    Make("tactile", "gelsight", "make_gelsight", "emulate_gelsight"),
    Make("tactile", "lerobot", "make_lerobot"),
)

# Key of the lab file that names the driver.
DRIVER_KEYS: Mapping[DeviceKind, str] = {
    "force_torque": "ft.driver",
    "tactile": "gelsight.driver",
    "gripper": "wsg.driver",
    "arm": "melfa.driver",
}


def load_driver(kind: DeviceKind, settings: HardwareSettings) -> Any:
    """Return the callable that makes the driver of a lab file.

    Raises
    ------
    InputError
        If no installed package offers the driver, or if it cannot be imported.

    """
    name, where = driver_name(kind, settings), DRIVER_KEYS[kind]
    for make in MAKES:
        if (make.kind, make.name) == (kind, name):
            return make.load_driver()
    offered = {point.name: point for point in entry_points(group=f"touchdown.{kind}")}
    if name not in offered:
        raise unknown_driver_error(name, where, driver_names(kind))
    said, fix = f"The driver '{name}' cannot be loaded", "Reinstall its package."
    with errors_as_input(said, where, fix, ImportError, AttributeError):
        return offered[name].load()


def driver_name(kind: DeviceKind, settings: HardwareSettings) -> str:
    """Return the name of the driver in a lab file."""
    table, field = DRIVER_KEYS[kind].split(".")
    return str(getattr(getattr(settings, table), field))


def driver_names(kind: DeviceKind) -> list[str]:
    """Return the names of the drivers that are shipped or installed."""
    installed = sorted(point.name for point in entry_points(group=f"touchdown.{kind}"))
    return [*(make.name for make in MAKES if make.kind == kind), *installed]


def drivers() -> Mapping[str, list[str]]:
    """Return the names of the drivers by the key of the lab file."""
    return {key: driver_names(kind) for kind, key in DRIVER_KEYS.items()}


def emulated_makes() -> Mapping[str, Make]:
    """Return the makes that have an emulator, by their name for ``touchdown emulate``."""
    return {make.emulated_as or make.name: make for make in MAKES if make.emulator}


def refuse_unknown_drivers(settings: HardwareSettings, where: str) -> None:
    """Raise ``InputError`` for the first unknown driver; none is loaded."""
    for kind, key in DRIVER_KEYS.items():
        name, known = driver_name(kind, settings), driver_names(kind)
        if name not in known:
            raise unknown_driver_error(name, f"{where}, {key}", known)


def unknown_driver_error(name: str, where: str, known: Sequence[str]) -> InputError:
    """Return the error for a driver that is neither shipped nor installed."""
    return InputError(
        f"There is no driver '{name}'.",
        where,
        f"Use one of {', '.join(known)}, or install the package that offers it.",
    )
