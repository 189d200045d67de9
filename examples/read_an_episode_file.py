"""
Read an episode with the MCAP reader
====================================

An episode file is MCAP with ROS 2 messages. The reader of the MCAP project lists its topics, and
Foxglove opens it.
"""

import tempfile
from collections import Counter

import matplotlib.pyplot as plt
from mcap.reader import make_reader

import touchdown as td

with tempfile.TemporaryDirectory() as folder, td.Dataset.open(folder, person="Ann") as dataset:
    with td.simulated_bench() as bench:
        bench.dataset = dataset
        bench.run(td.CollectRequest(piece="pot", bottom="circle15", count=1, person="Ann"))
    (entry,) = dataset
    with dataset.path(entry.uuid).open("rb") as file:
        messages = [
            (channel.topic, schema.name, 1e-9 * message.log_time)
            for schema, channel, message in make_reader(file).iter_messages()
        ]

for (topic, schema), count in sorted(Counter((t, s) for t, s, _ in messages).items()):
    print(f"{topic:28} {schema:34} {count}")

# %%
# Time of each message.

topics = sorted({topic for topic, _, _ in messages})
start_s = min(time_s for _, _, time_s in messages)
figure, axes = plt.subplots(figsize=(8, 3.6))
for row, topic in enumerate(topics):
    times_s = [time_s - start_s for name, _, time_s in messages if name == topic]
    axes.plot(times_s, [row] * len(times_s), "|")
axes.set_yticks(range(len(topics)), topics)
axes.set(xlabel="time (s)")
figure.tight_layout()
plt.show()
