//! Old names of scene keys and options.

/// Old and new name: dotted keys of a scene file, and options of the command line.
pub const RENAMED: [(&str, &str); 13] = [
    ("live.incomplete_seconds", "live.block_timeout_seconds"),
    ("live.relay_seconds", "live.relay_timeout_seconds"),
    ("time.step", "time.seed_step"),
    ("time.stride", "time.snapshots_per_slide"),
    ("flow.gap", "flow.difference_step"),
    ("network.follow_aspect", "network.scale_levels_by_aspect"),
    ("training.ring", "training.replay_buffer"),
    ("trust.audit_per_cell", "trust.audit_min_per_cell"),
    ("trust.audit_most_per_cell", "trust.audit_max_per_cell"),
    ("render.missing", "render.missing_color"),
    ("publish.when_full", "publish.when_disk_slow"),
    ("device.polite", "device.low_priority"),
    ("--once", "--exit-at-end"),
];

/// Returns the new name of a key or option. `None` if it was not renamed.
pub fn renamed(old: &str) -> Option<&'static str> {
    RENAMED.iter().find(|(name, _)| *name == old).map(|(_, new)| *new)
}
