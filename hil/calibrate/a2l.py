"""The firmware's memory as an A2L file (ASAM MCD-2 MC 1.7): what INCA, CANape or pyxcp need to know of it.

Measurements stand in single precision at address extension 1, so that classic CAN carries one in a frame;
characteristics in double, so that what is set is what the firmware has. Physical units are those of the tables.
"""

from __future__ import annotations

from math import pi

from controller.records import FAULTS, MODES
from hil.calibrate.daq import EVENTS, PAYLOAD
from hil.calibrate.elements import CHOICES, Element
from hil.calibrate.memory import CALIBRATION, SHORT, Memory
from hil.calibrate.slave import NAME

__all__ = ["a2l_of"]

# What the blocks of IF_DATA XCP below consist of, in the words of the standard's XCP_104.aml.
_AML = """
    block "IF_DATA" taggedunion if_data {
      "XCP" struct {
        taggedstruct {
          block "PROTOCOL_LAYER" struct {
            uint; uint; uint; uint; uint; uint; uint; uint;
            uchar; uint;
            enum { "BYTE_ORDER_MSB_LAST" = 0, "BYTE_ORDER_MSB_FIRST" = 1 };
            enum { "ADDRESS_GRANULARITY_BYTE" = 1, "ADDRESS_GRANULARITY_WORD" = 2, "ADDRESS_GRANULARITY_DWORD" = 4 };
            taggedstruct {
              ("OPTIONAL_CMD" enum {
                "GET_COMM_MODE_INFO" = 251, "GET_ID" = 250, "SET_REQUEST" = 249, "GET_SEED" = 248, "UNLOCK" = 247,
                "SET_MTA" = 246, "UPLOAD" = 245, "SHORT_UPLOAD" = 244, "BUILD_CHECKSUM" = 243, "DOWNLOAD" = 240,
                "SET_CAL_PAGE" = 235, "GET_CAL_PAGE" = 234, "GET_PAG_PROCESSOR_INFO" = 233, "GET_SEGMENT_INFO" = 232,
                "GET_PAGE_INFO" = 231, "SET_SEGMENT_MODE" = 230, "GET_SEGMENT_MODE" = 229, "COPY_CAL_PAGE" = 228,
                "CLEAR_DAQ_LIST" = 227, "SET_DAQ_PTR" = 226, "WRITE_DAQ" = 225, "SET_DAQ_LIST_MODE" = 224,
                "GET_DAQ_LIST_MODE" = 223, "START_STOP_DAQ_LIST" = 222, "START_STOP_SYNCH" = 221,
                "GET_DAQ_CLOCK" = 220, "READ_DAQ" = 219, "GET_DAQ_PROCESSOR_INFO" = 218,
                "GET_DAQ_RESOLUTION_INFO" = 217, "GET_DAQ_EVENT_INFO" = 215, "FREE_DAQ" = 214, "ALLOC_DAQ" = 213,
                "ALLOC_ODT" = 212, "ALLOC_ODT_ENTRY" = 211
              })*;
              "COMMUNICATION_MODE_SUPPORTED" taggedunion {
                "BLOCK" taggedstruct { "SLAVE"; "MASTER" struct { uchar; uchar; }; };
                "INTERLEAVED" uchar;
              };
            };
          };
          block "DAQ" struct {
            enum { "STATIC" = 0, "DYNAMIC" = 1 };
            uint; uint; uchar;
            enum { "OPTIMISATION_TYPE_DEFAULT" = 0, "OPTIMISATION_TYPE_ODT_TYPE_16" = 1 };
            enum { "ADDRESS_EXTENSION_FREE" = 0, "ADDRESS_EXTENSION_ODT" = 1, "ADDRESS_EXTENSION_DAQ" = 3 };
            enum { "IDENTIFICATION_FIELD_TYPE_ABSOLUTE" = 0, "IDENTIFICATION_FIELD_TYPE_RELATIVE_BYTE" = 1 };
            enum { "GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE" = 1, "GRANULARITY_ODT_ENTRY_SIZE_DAQ_WORD" = 2 };
            uchar;
            enum { "NO_OVERLOAD_INDICATION" = 0, "OVERLOAD_INDICATION_PID" = 1, "OVERLOAD_INDICATION_EVENT" = 2 };
            taggedstruct {
              "PRESCALER_SUPPORTED";
              block "STIM" struct {
                enum { "GRANULARITY_ODT_ENTRY_SIZE_STIM_BYTE" = 1, "GRANULARITY_ODT_ENTRY_SIZE_STIM_WORD" = 2,
                       "GRANULARITY_ODT_ENTRY_SIZE_STIM_DWORD" = 4 };
                uchar;
                taggedstruct { "BIT_STIM_SUPPORTED"; };
              };
              block "TIMESTAMP_SUPPORTED" struct {
                uint;
                enum { "NO_TIME_STAMP" = 0, "SIZE_BYTE" = 1, "SIZE_WORD" = 2, "SIZE_DWORD" = 4 };
                enum { "UNIT_1NS" = 0, "UNIT_10NS" = 1, "UNIT_100NS" = 2, "UNIT_1US" = 3, "UNIT_10US" = 4,
                       "UNIT_100US" = 5, "UNIT_1MS" = 6, "UNIT_10MS" = 7, "UNIT_100MS" = 8, "UNIT_1S" = 9 };
                taggedstruct { "TIMESTAMP_FIXED"; };
              };
              (block "EVENT" struct {
                char[101]; char[9]; uint;
                enum { "DAQ" = 1, "STIM" = 2, "DAQ_STIM" = 3 };
                uchar; uchar; uchar; uchar;
              })*;
            };
          };
          block "PAG" struct { uchar; taggedstruct { "FREEZE_SUPPORTED"; }; };
          block "SEGMENT" struct {
            uchar; uchar; uchar; uchar; uchar;
            taggedstruct {
              block "CHECKSUM" struct {
                enum { "XCP_ADD_11" = 1, "XCP_CRC_16" = 7, "XCP_CRC_16_CITT" = 8, "XCP_CRC_32" = 9 };
                taggedstruct { "MAX_BLOCK_SIZE" ulong; };
              };
              (block "PAGE" struct {
                uchar;
                enum { "ECU_ACCESS_NOT_ALLOWED" = 0, "ECU_ACCESS_WITHOUT_XCP_ONLY" = 1,
                       "ECU_ACCESS_WITH_XCP_ONLY" = 2, "ECU_ACCESS_DONT_CARE" = 3 };
                enum { "XCP_READ_ACCESS_NOT_ALLOWED" = 0, "XCP_READ_ACCESS_WITHOUT_ECU_ONLY" = 1,
                       "XCP_READ_ACCESS_WITH_ECU_ONLY" = 2, "XCP_READ_ACCESS_DONT_CARE" = 3 };
                enum { "XCP_WRITE_ACCESS_NOT_ALLOWED" = 0, "XCP_WRITE_ACCESS_WITHOUT_ECU_ONLY" = 1,
                       "XCP_WRITE_ACCESS_WITH_ECU_ONLY" = 2, "XCP_WRITE_ACCESS_DONT_CARE" = 3 };
                taggedstruct { "INIT_SEGMENT" uchar; };
              })*;
            };
          };
          block "XCP_ON_CAN" struct {
            uint;
            taggedstruct {
              "CAN_ID_MASTER" ulong; "CAN_ID_SLAVE" ulong; "BAUDRATE" ulong; "SAMPLE_POINT" uchar;
              "SAMPLE_RATE" enum { "SINGLE" = 1, "TRIPLE" = 3 };
              "BTL_CYCLES" uchar; "SJW" uchar;
              "SYNC_EDGE" enum { "SINGLE" = 1, "DUAL" = 2 };
            };
          };
        };
      };
    };"""
_COMMANDS = (
    "GET_COMM_MODE_INFO", "GET_ID", "SET_REQUEST", "GET_SEED", "UNLOCK", "SET_MTA", "UPLOAD", "SHORT_UPLOAD",
    "BUILD_CHECKSUM", "DOWNLOAD", "SET_CAL_PAGE", "GET_CAL_PAGE", "GET_PAG_PROCESSOR_INFO", "GET_SEGMENT_INFO",
    "GET_PAGE_INFO", "SET_SEGMENT_MODE", "GET_SEGMENT_MODE", "COPY_CAL_PAGE", "CLEAR_DAQ_LIST", "SET_DAQ_PTR",
    "WRITE_DAQ", "SET_DAQ_LIST_MODE", "GET_DAQ_LIST_MODE", "START_STOP_DAQ_LIST", "START_STOP_SYNCH", "GET_DAQ_CLOCK",
    "READ_DAQ", "GET_DAQ_PROCESSOR_INFO", "GET_DAQ_RESOLUTION_INFO", "GET_DAQ_EVENT_INFO", "FREE_DAQ", "ALLOC_DAQ",
    "ALLOC_ODT", "ALLOC_ODT_ENTRY",
)  # fmt: skip
_SHOWN = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3), "A": ("mA", 1e3), "rad": ("deg", 180.0 / pi), "s": ("s", 1.0)}
_WIDE = 1e12  # limit of a measurement that has none


def _word(unit: str) -> str:
    """A unit as part of a name."""
    return "".join(
        {"/": "_per_", "%": "percent", "-": "none", "(": "", ")": "", " ": "_", "^": ""}.get(c, c) for c in unit
    )


def _method(unit: str, shown: str, factor: float) -> str:
    return (
        f'    /begin COMPU_METHOD CM_{_word(unit)}_{_word(shown)} "{unit} shown in {shown}" LINEAR "%12.6" "{shown}"\n'
        f"      COEFFS_LINEAR {factor!r} 0\n    /end COMPU_METHOD\n"
    )


def _choice(name: str, words: tuple[str, ...]) -> str:
    pairs = "".join(f'      {i} "{w}"\n' for i, w in enumerate(words))
    return (
        f'    /begin COMPU_METHOD CM_{name} "{name}" TAB_VERB "%3.0" ""\n      COMPU_TAB_REF VT_{name}\n'
        f"    /end COMPU_METHOD\n"
        f'    /begin COMPU_VTAB VT_{name} "{name}" TAB_VERB {len(words)}\n{pairs}    /end COMPU_VTAB\n'
    )


class _Methods:
    """The conversions in use."""

    def __init__(self) -> None:
        self.units: dict[tuple[str, str], float] = {}

    def of(self, unit: str, shown: str | None = None, factor: float | None = None) -> tuple[str, float]:
        """Name of the conversion and its factor from the number in memory to the one shown."""
        if shown is None or factor is None:
            shown, factor = _SHOWN.get(unit, (unit, 1.0))
        self.units.setdefault((unit, shown), factor)
        return f"CM_{_word(unit)}_{_word(shown)}", factor

    def text(self) -> str:
        """All of them."""
        out = "".join(_method(unit, shown, f) for (unit, shown), f in sorted(self.units.items()))
        return out + "".join(_choice(name, words) for name, words in {"mode": MODES, **CHOICES}.items())


def _group(name: str, meaning: str, kind: str, members: list[str]) -> str:
    lines = "".join(f"        {m}\n" for m in members)
    return (
        f'    /begin GROUP {name} "{meaning}"\n      ROOT\n      /begin {kind}\n{lines}      /end {kind}\n'
        f"    /end GROUP\n"
    )


def _measurements(memory: Memory, methods: _Methods) -> tuple[str, str]:
    out: list[str] = []
    groups: dict[str, list[str]] = {}
    for s in memory.signals:
        area, _, name = s.name.partition("_")
        base = s.address & ~0xFFFFFF
        address = base + (s.address - base) // 2
        method = "CM_mode" if name == "mode" else methods.of(s.unit)[0]
        meaning = s.meaning if name != "faults" else f"bits from 0 on: {', '.join(FAULTS)}"
        out.append(
            f'    /begin MEASUREMENT {s.name} "{meaning}"\n'
            f"      FLOAT32_IEEE {method} 0 0 {-_WIDE:g} {_WIDE:g}\n"
            f"      ECU_ADDRESS {address:#010x} ECU_ADDRESS_EXTENSION {SHORT}\n    /end MEASUREMENT\n"
        )
        groups.setdefault(area, []).append(s.name)
    what = {"input": "inputs of the tick", "output": "outputs of the tick", "state": "state after the tick"}
    text = "".join(_group(f"{area}s", what[area], "REF_MEASUREMENT", names) for area, names in groups.items())
    return "".join(out), text


def _limits(e: Element) -> tuple[float, float]:
    return e.low / e.factor, e.high / e.factor


def _values(memory: Memory, methods: _Methods) -> tuple[str, str]:
    out: list[str] = []
    groups: dict[str, list[str]] = {}
    for i, e in enumerate(memory.elements):
        if e.of_curve or e.fixed:
            continue
        if e.whole:
            method = f"CM_{e.name}"
        else:
            method = methods.of(e.unit, e.border, 1.0 / e.factor)[0]
        low, high = _limits(e)
        out.append(
            f'    /begin CHARACTERISTIC {e.name} "{e.meaning}"\n'
            f"      VALUE {CALIBRATION + 8 * i:#010x} RL_VALUE 0 {method} {low:.12g} {high:.12g}\n"
            f"    /end CHARACTERISTIC\n"
        )
        groups.setdefault(e.section if e.table == "calibration" else e.table, []).append(e.name)
    text = "".join(_group(f"cal_{s}", s, "REF_CHARACTERISTIC", names) for s, names in groups.items())
    return "".join(out), text


def _curves(memory: Memory, methods: _Methods) -> tuple[str, str]:
    out, axes, names = [], {}, []
    for c in memory.curves:
        e, x = memory.elements[c.first], memory.elements[c.axis]
        axis = f"axis_{x.key}_{x.table}"
        method = methods.of(e.unit, e.border, 1.0 / e.factor)[0]
        axis_method = methods.of(x.unit, x.border, 1.0 / x.factor)[0]
        if axis not in axes:
            low, high = _limits(x)
            axes[axis] = (
                f'    /begin AXIS_PTS {axis} "{x.meaning}"\n'
                f"      {CALIBRATION + 8 * c.axis:#010x} NO_INPUT_QUANTITY RL_AXIS 0 {axis_method} {c.n} {low:.12g} "
                f"{high:.12g}\n    /end AXIS_PTS\n"
            )
        low, high = _limits(e)
        x_low, x_high = _limits(x)
        out.append(
            f'    /begin CHARACTERISTIC {c.name} "{c.meaning}"\n'
            f"      CURVE {CALIBRATION + 8 * c.first:#010x} RL_CURVE 0 {method} {low:.12g} {high:.12g}\n"
            f"      /begin AXIS_DESCR COM_AXIS NO_INPUT_QUANTITY {axis_method} {c.n} {x_low:.12g} {x_high:.12g}\n"
            f"        AXIS_PTS_REF {axis}\n      /end AXIS_DESCR\n    /end CHARACTERISTIC\n"
        )
        names.append(c.name)
    return "".join(axes.values()) + "".join(out), _group("curves", "tables", "REF_CHARACTERISTIC", [*axes, *names])


def _if_data(master: int, slave: int) -> str:
    commands = "".join(f"        OPTIONAL_CMD {name}\n" for name in _COMMANDS)
    events = "".join(
        f'        /begin EVENT "{name}" "{name}" {i} DAQ_STIM 0xFF {period} 6 0 /end EVENT\n'
        for i, (name, period) in enumerate(EVENTS)
    )
    return (
        "    /begin IF_DATA XCP\n"
        "      /begin PROTOCOL_LAYER\n"
        "        0x0100 1000 1000 1000 1000 1000 1000 1000 8 8 BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE\n"
        f"{commands}        COMMUNICATION_MODE_SUPPORTED BLOCK SLAVE\n"
        "      /end PROTOCOL_LAYER\n"
        "      /begin DAQ\n"
        f"        DYNAMIC 0 {len(EVENTS)} 0 OPTIMISATION_TYPE_DEFAULT ADDRESS_EXTENSION_FREE\n"
        "        IDENTIFICATION_FIELD_TYPE_ABSOLUTE GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE "
        f"{PAYLOAD} OVERLOAD_INDICATION_EVENT\n"
        "        PRESCALER_SUPPORTED\n"
        "        /begin STIM GRANULARITY_ODT_ENTRY_SIZE_STIM_DWORD 4 /end STIM\n"
        "        /begin TIMESTAMP_SUPPORTED 1 SIZE_WORD UNIT_1MS TIMESTAMP_FIXED /end TIMESTAMP_SUPPORTED\n"
        f"{events}      /end DAQ\n"
        "      /begin PAG 1 FREEZE_SUPPORTED /end PAG\n"
        "      /begin XCP_ON_CAN 0x0100\n"
        f"        CAN_ID_MASTER {master:#x} CAN_ID_SLAVE {slave:#x} BAUDRATE 500000\n"
        "      /end XCP_ON_CAN\n"
        "    /end IF_DATA\n"
    )


def _segment(memory: Memory) -> str:
    size = 8 * len(memory.elements)
    access = "ECU_ACCESS_DONT_CARE XCP_READ_ACCESS_DONT_CARE"
    return (
        '    /begin MOD_PAR "VaneLoop"\n'
        f'      /begin MEMORY_SEGMENT calibration "scalars and tables" DATA RAM INTERN {CALIBRATION:#010x} {size:#x} '
        "-1 -1 -1 -1 -1\n"
        "        /begin IF_DATA XCP\n"
        "          /begin SEGMENT 0 2 0 0 0\n"
        "            /begin CHECKSUM XCP_CRC_32 MAX_BLOCK_SIZE 1048576 /end CHECKSUM\n"
        f"            /begin PAGE 0 {access} XCP_WRITE_ACCESS_DONT_CARE INIT_SEGMENT 0 /end PAGE\n"
        f"            /begin PAGE 1 {access} XCP_WRITE_ACCESS_NOT_ALLOWED INIT_SEGMENT 0 /end PAGE\n"
        "          /end SEGMENT\n        /end IF_DATA\n      /end MEMORY_SEGMENT\n    /end MOD_PAR\n"
    )


def a2l_of(memory: Memory, *, master: int, slave: int) -> str:
    """Return the A2L file of a memory; ``master`` and ``slave`` are the CAN identifiers."""
    methods = _Methods()
    parts = [_measurements(memory, methods), _values(memory, methods), _curves(memory, methods)]
    layouts = "".join(
        f"    /begin RECORD_LAYOUT {name}\n      {what} 1 FLOAT64_IEEE {order} DIRECT\n    /end RECORD_LAYOUT\n"
        for name, what, order in (
            ("RL_VALUE", "FNC_VALUES", "COLUMN_DIR"),
            ("RL_CURVE", "FNC_VALUES", "COLUMN_DIR"),
            ("RL_AXIS", "AXIS_PTS_X", "INDEX_INCR"),
        )
    )
    return (
        "ASAP2_VERSION 1 71\n"
        '/begin PROJECT VaneLoop "variable guide vane controller"\n'
        '  /begin HEADER "written by vaneloop a2l" /end HEADER\n'
        f'  /begin MODULE {NAME} "firmware"\n'
        f"    /begin A2ML{_AML}\n    /end A2ML\n"
        f"{_segment(memory)}"
        '    /begin MOD_COMMON ""\n      BYTE_ORDER MSB_LAST\n      ALIGNMENT_FLOAT64_IEEE 8\n    /end MOD_COMMON\n'
        f"{_if_data(master, slave)}{layouts}{methods.text()}"
        f"{''.join(items for items, _ in parts)}{''.join(groups for _, groups in parts)}"
        "  /end MODULE\n/end PROJECT\n"
    )
