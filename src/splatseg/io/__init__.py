"""Files and what they become: splats, captures, evidence, layers, scene folders."""
