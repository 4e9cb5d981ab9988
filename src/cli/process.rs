//! Limits and priority of a process beside a simulation.

use super::messages;

/// Maximum number of open files: sixteen followers of a relay with a thousand blocks.
const MAX_OPEN_FILES: u64 = 1 << 14;
/// File in which a process says how readily the kernel may end it when memory is short (proc(5)). Raising it needs no privilege.
const OUT_OF_MEMORY: &str = "/proc/self/oom_score_adj";
/// The kernel ends this process first.
const FIRST_TO_END: &str = "1000";

/// Priority of a process beside a simulation.
#[derive(Debug, clap::Args)]
pub struct Nice {
    /// Niceness towards a simulation on the same cores: 0 (same priority) to 19 (lowest).
    #[arg(long, default_value_t = 10, value_name = "N", value_parser = clap::value_parser!(i32).range(0..=19))]
    nice: i32,
}

impl Nice {
    /// Prepares the process for life beside a simulation: lowers the priority of all threads, raises the limit of open files (each ring takes a
    /// descriptor of each follower), and lets the kernel end this process first when memory is short. Prints what the system refuses.
    pub fn apply(&self) {
        if let Err(error) = std::fs::write(OUT_OF_MEMORY, FIRST_TO_END) {
            messages::note(format_args!("{OUT_OF_MEMORY} stays as it is: {error}"));
        }
        if self.nice > 0
            && let Err(error) = lower(self.nice)
        {
            messages::note(format_args!("priority stays as it is: {error}"));
        }
        if let Err(error) = rlimit::increase_nofile_limit(MAX_OPEN_FILES) {
            messages::note(format_args!("the limit of open files stays as it is: {error}"));
        }
    }
}

/// Sets the niceness of all threads; threads started later inherit it.
fn lower(nice: i32) -> std::io::Result<()> {
    // SAFETY: reads the priority of this process.
    if unsafe { libc::getpriority(libc::PRIO_PROCESS, 0) } >= nice {
        return Ok(());
    }
    for task in std::fs::read_dir("/proc/self/task")? {
        let Some(thread) = task?.file_name().to_str().and_then(|name| name.parse().ok()) else { continue };
        // SAFETY: changes a priority and touches no memory.
        if unsafe { libc::setpriority(libc::PRIO_PROCESS, thread, nice) } != 0 {
            let error = std::io::Error::last_os_error();
            // A thread may have ended meanwhile.
            if error.raw_os_error() != Some(libc::ESRCH) {
                return Err(error);
            }
        }
    }
    Ok(())
}
