//! Comparison of the window's size with the free memory of the host.

use ridgewatch_base::memory::gib;

/// Warning for a window (in bytes) that exceeds the available memory; `None` otherwise.
pub(super) fn short(window: u64, available: Option<u64>) -> Option<String> {
    let available = available.filter(|available| window > *available)?;
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
    }
}
