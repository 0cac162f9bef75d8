"""Gate a .vxp or CSV that another instrument recorded: python gate_a_signal.py trace.vxp gating.png."""

import sys

import tidegate

trace, picture = sys.argv[1:]
signal = tidegate.read_signal(trace)
exhale = tidegate.AmplitudeWindow(lower=-30.0, upper=35.0, unit="percent")
gating = tidegate.gate(signal, exhale)
print(f"duty cycle {gating.duty_percent:.0f} %, residual motion {gating.residual_mm:.1f} mm")
tidegate.plot(gating, picture)
