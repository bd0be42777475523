"""The IEEE 13 node test feeder, from its published tables: lines on poles and in the ground, one regulator.

Kersting, "Radial distribution test feeders", IEEE PES Winter Meeting 2001. Loads here are of constant power,
and the source is stiff.
"""

from __future__ import annotations

CODES = {
    "601": ("0.3465|0.1560 0.3375|0.1580 0.1535 0.3414", "1.0179|0.5017 1.0478|0.4236 0.3849 1.0348", ""),
    "602": ("0.7526|0.1580 0.7475|0.1560 0.1535 0.7436", "1.1814|0.4236 1.1983|0.5017 0.3849 1.2112", ""),
    "603": ("1.3238|0.2066 1.3294", "1.3569|0.4591 1.3471", ""),
    "605": ("1.3292", "1.3475", ""),
    "606": ("0.7982|0.3192 0.7891|0.2849 0.3192 0.7982", "0.4463|0.0328 0.4041|-0.0143 0.0328 0.4463",
            "257|0 257|0 0 257"),
    "607": ("1.3425", "0.5124", "236"),
}  # fmt: skip
"""Ohm per mile, and nF per mile where the tables have more than OpenDSS assumes."""

LINES = (
    ("rg60.1.2.3", "632.1.2.3", "601", 2000), ("632.1.2.3", "671.1.2.3", "601", 2000),
    ("671.1.2.3", "680.1.2.3", "601", 1000), ("632.1.2.3", "633.1.2.3", "602", 500),
    ("632.3.2", "645.3.2", "603", 500), ("645.3.2", "646.3.2", "603", 300),
    ("692.1.2.3", "675.1.2.3", "606", 500), ("671.1.3", "684.1.3", "603", 300),
    ("684.3", "611.3", "605", 300), ("684.1", "652.1", "607", 800),
)  # fmt: skip
"""Ends, configuration, feet."""

LOADS = (
    ("671.1.2.3", "delta", 4.16, 1155, 660), ("634.1", "wye", 0.277, 160, 110),
    ("634.2", "wye", 0.277, 120, 90), ("634.3", "wye", 0.277, 120, 90),
    ("645.2", "wye", 2.4, 170, 125), ("646.2.3", "delta", 4.16, 230, 132),
    ("692.3.1", "delta", 4.16, 170, 151), ("675.1", "wye", 2.4, 485, 190), ("675.2", "wye", 2.4, 68, 60),
    ("675.3", "wye", 2.4, 290, 212), ("611.3", "wye", 2.4, 170, 80), ("652.1", "wye", 2.4, 128, 86),
)  # fmt: skip
"""Bus, connection, kV, kW, kvar."""


def thirteen() -> str:
    """Return it as an OpenDSS master file, its regulator under control."""
    out = ["clear", "new circuit.thirteen basekv=115 pu=1.0001 bus1=source mvasc3=20000 mvasc1=21000"]
    out.append(
        "new transformer.sub windings=2 buses=(source,650) conns=(delta,wye) kvs=(115,4.16) kvas=(5000,5000) "
        "xhl=0.008"
    )
    for k, phase in enumerate("123"):
        out.append(
            f"new transformer.reg{phase} phases=1 windings=2 buses=(650.{phase},rg60.{phase}) kvs=(2.4,2.4) "
            "kvas=(1666,1666) xhl=0.01 %loadloss=0.01"
        )
        out.append(
            f"new regcontrol.c{phase} transformer=reg{phase} winding=2 vreg={122 - k} band=2 ptratio=20 "
            "ctprim=700 r=3 x=9"
        )
    for name, (r, x, c) in CODES.items():
        charging = f" cmatrix=({c})" if c else ""
        count = r.count("|") + 1
        out.append(f"new linecode.{name} nphases={count} units=mi rmatrix=({r}) xmatrix=({x}){charging}")
    for one, other, code, feet in LINES:
        out.append(
            f"new line.{one.partition('.')[0]}-{other.partition('.')[0]} bus1={one} bus2={other} "
            f"phases={one.count('.')} linecode={code} length={feet} units=ft"
        )
    out.append("new line.switch bus1=671 bus2=692 switch=yes r1=1e-4 r0=1e-4 x1=0 x0=0 c1=0 c0=0")
    out.append(
        "new transformer.xfm windings=2 buses=(633,634) conns=(wye,wye) kvs=(4.16,0.48) kvas=(500,500) xhl=2 "
        "%rs=(0.55,0.55)"
    )
    for k, (bus, conn, kv, kw, kvar) in enumerate(LOADS):
        phases = 3 if bus.count(".") == 3 else 1
        out.append(
            f"new load.l{k} bus1={bus} phases={phases} conn={conn} kv={kv} kw={kw} kvar={kvar} vminpu=0.5"
        )
    out += ["new capacitor.c1 bus1=675 phases=3 kvar=600 kv=4.16", "new capacitor.c2 bus1=611.3 phases=1 "
            "kvar=100 kv=2.4"]  # fmt: skip
    out += ["set voltagebases=[115,4.16,0.48]", "calcvoltagebases", "solve"]
    return "\n".join(out)
