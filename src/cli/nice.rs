//! Whoever runs beside a simulation steps back for it: `--nice` where both want a core, and always where memory is out.

use super::messages;

/// How far to step back.
#[derive(Debug, clap::Args)]
pub struct Nice {
    /// How far to step back for the simulation when both want the same core: 0 (not at all) to 19.
    #[arg(long, default_value_t = 10, value_name = "N", value_parser = clap::value_parser!(i32).range(0..=19))]
    nice: i32,
}

impl Nice {
    /// Lowers the priority of all threads that are there; those that they start later have it too. Where the machine or the job runs out of memory, the
    /// kernel is to end this process and none of the simulation's. Where the system refuses, that is said.
    pub fn step_back(&self) {
        if let Err(error) = std::fs::write(OUT_OF_MEMORY, OFFERED) {
            messages::note(format_args!("{OUT_OF_MEMORY} stays as it is: {error}"));
        }
        if self.nice > 0
            && let Err(error) = lower(self.nice)
        {
            messages::note(format_args!("priority stays as it is: {error}"));
        }
    }
}

/// Where a process says how readily the kernel may end it when memory is out (proc(5)); raising it takes no rights.
const OUT_OF_MEMORY: &str = "/proc/self/oom_score_adj";
/// Before all others.
const OFFERED: &str = "1000";

fn lower(nice: i32) -> std::io::Result<()> {
    // SAFETY: asks for this process's own.
    if unsafe { libc::getpriority(libc::PRIO_PROCESS, 0) } >= nice {
        // Whoever started it has stepped back further already.
        return Ok(());
    }
    for task in std::fs::read_dir("/proc/self/task")? {
        let Some(thread) = task?.file_name().to_str().and_then(|name| name.parse().ok()) else { continue };
        // SAFETY: changes a priority and touches no memory.
        if unsafe { libc::setpriority(libc::PRIO_PROCESS, thread, nice) } != 0 {
            let error = std::io::Error::last_os_error();
            // One that has ended meanwhile.
            if error.raw_os_error() != Some(libc::ESRCH) {
                return Err(error);
            }
        }
    }
    Ok(())
}
