"""
Inject a fault
==============

Stop the wrist sensor for one second during a press. The trial is aborted with a named fault, the
arm stands, and the gripper keeps the piece.
"""

import matplotlib.pyplot as plt

import touchdown as td
from touchdown.backend.core import FaultRaised, PhaseEntered

events = []
with td.simulated_bench(disturbances=("force_torque:stop@4+1",)) as bench:
    bench.events.subscribe(events.append)
    result = bench.run(td.StackRequest(piece="pot", bottoms=("short",), strategy="fused", seed=7))

for fault in result.faults:
    print(f"{fault.code}: {fault.what} {fault.consequence} {fault.next_step}")
print(result.ending, "-", result.reason)

# %%
# Phases of the trial on the bench clock.

phases = [event for event in events if isinstance(event, PhaseEntered)]
ends_s = [event.t_s for event in phases[1:]] + [events[-1].t_s]
figure, axes = plt.subplots(figsize=(7, 3.2))
for row, (event, end_s) in enumerate(zip(phases, ends_s, strict=True)):
    axes.barh(row, max(end_s - event.t_s, 0.02), left=event.t_s, color="C0")
axes.set_yticks(range(len(phases)), [f"{event.phase} {event.probe}" for event in phases])
axes.invert_yaxis()
for event in events:
    if isinstance(event, FaultRaised):
        axes.axvline(event.t_s, color="C3", label=event.fault.code)
axes.set(xlabel="bench clock (s)")
axes.legend()
figure.tight_layout()
plt.show()
