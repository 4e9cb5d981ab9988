//! Comparison of the window's size with the free memory of the host.

/// Free bytes without swapping, or left by the control group, whichever is less; `None` if the system reports neither.
pub(super) fn available() -> Option<u64> {
    let text = |path: &str| std::fs::read_to_string(path).ok();
    let free = text("/proc/meminfo").and_then(|text| {
        let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?.to_owned();
        Some(line.split_whitespace().next()?.parse::<u64>().ok()? * 1024)
    });
    let number = |path: &str| text(path).and_then(|text| text.trim().parse::<u64>().ok());
    let group = number("/sys/fs/cgroup/memory.max").map(|most| most.saturating_sub(number("/sys/fs/cgroup/memory.current").unwrap_or(0)));
    free.into_iter().chain(group).min()
}

/// Warning for a window (in bytes) that exceeds the available memory; `None` otherwise.
pub(super) fn short(window: u64, available: Option<u64>) -> Option<String> {
    let available = available.filter(|available| window > *available)?;
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    Some(format!(
        "the window needs {:.1} GiB, but only {:.1} GiB are free: reduce tau, read a part of the archive (archive.region, archive.level), or use fewer nodes",
        gib(window),
        gib(available)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_that_does_not_fit_is_told_of() {
        assert_eq!((short(1 << 30, Some(1 << 30)), short(1 << 40, None)), (None, None));
        let said = short(3 << 30, Some(1 << 30)).unwrap();
        assert!(said.contains("3.0 GiB") && said.contains("1.0 GiB"), "{said}");
        if cfg!(target_os = "linux") {
            assert!(available().is_some_and(|bytes| bytes > 0));
        }
    }
}
