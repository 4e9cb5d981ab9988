//! The command line: parses, calls, and turns the result into an exit status (0 done, 1 failed, 2 usage or config).

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    // SAFETY: no thread has been started.
    unsafe { ridgewatch::source::read_without_locks() };
    let arguments = match cli::Arguments::read() {
        Ok(arguments) => arguments,
        Err(error) => {
            // Help and version are not failures; clap knows their stream.
            let failed = error.use_stderr();
            return if error.print().is_ok() && !failed { ExitCode::SUCCESS } else { ExitCode::from(2) };
        }
    };
    ridgewatch::source::report_crashes();
    cli::messages::start(arguments.common.verbose);
    match cli::run(arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            cli::messages::fail(&error);
            ExitCode::from(cli::exit_status(&error))
        }
    }
}
