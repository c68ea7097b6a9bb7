"""The paper's experiments, one small file each: only what differs (Table 2)."""
