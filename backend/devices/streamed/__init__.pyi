from .compliance import AIR_S as AIR_S
from .compliance import OLD_S as OLD_S
from .compliance import TRIP_AT_ONCE_N as TRIP_AT_ONCE_N
from .compliance import TRIP_N as TRIP_N
from .compliance import Loop as Loop
from .moves import ACCELERATION_MM_S2 as ACCELERATION_MM_S2
from .moves import ARM as ARM
from .moves import HELD as HELD
from .moves import NOT_CONNECTED as NOT_CONNECTED
from .moves import NOTHING_MOVED as NOTHING_MOVED
from .moves import REPLACED as REPLACED
from .moves import STOPPED as STOPPED
from .moves import UNLOAD_MM as UNLOAD_MM
from .moves import ArmPress as ArmPress
from .moves import Felt as Felt
from .moves import Follow as Follow
from .moves import Program as Program
from .moves import Travel as Travel
from .moves import not_unloaded as not_unloaded
from .moves import refused_fault as refused_fault
from .press import TRIPPED as TRIPPED
from .press import UNFELT as UNFELT
from .press import MeasuredPlaces as MeasuredPlaces
from .press import no_contact as no_contact
from .setpoints import NOT_PRESSING as NOT_PRESSING
from .setpoints import StreamedOrders as StreamedOrders
from .setpoints import air_before as air_before
from .setpoints import jogging as jogging
from .setpoints import told_of as told_of
from .turns import ACCELERATION_RAD_S2 as ACCELERATION_RAD_S2
from .turns import JointFollow as JointFollow
from .turns import JointProgram as JointProgram
from .turns import JointTravel as JointTravel
from .turns import TurningFollow as TurningFollow
from .turns import TurningTravel as TurningTravel

__all__ = [
    "ACCELERATION_MM_S2",
    "ACCELERATION_RAD_S2",
    "AIR_S",
    "ARM",
    "HELD",
    "NOTHING_MOVED",
    "NOT_CONNECTED",
    "NOT_PRESSING",
    "OLD_S",
    "REPLACED",
    "STOPPED",
    "TRIPPED",
    "TRIP_AT_ONCE_N",
    "TRIP_N",
    "UNFELT",
    "UNLOAD_MM",
    "ArmPress",
    "Felt",
    "Follow",
    "JointFollow",
    "JointProgram",
    "JointTravel",
    "Loop",
    "MeasuredPlaces",
    "Program",
    "StreamedOrders",
    "Travel",
    "TurningFollow",
    "TurningTravel",
    "air_before",
    "jogging",
    "no_contact",
    "not_unloaded",
    "refused_fault",
    "told_of",
]
