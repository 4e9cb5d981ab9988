//! Messages on standard error.

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressFinish, ProgressState, ProgressStyle};
use ridgewatch::progress::work;
use std::io::{IsTerminal, Write, stderr};
use tracing_subscriber::EnvFilter;

/// Sends log lines to standard error; `RIDGEWATCH_LOG` overrides the level.
pub fn start(verbose: u8) {
    let level = match verbose {
        0 => "ridgewatch=warn",
        1 => "ridgewatch=info",
        _ => "ridgewatch=debug",
    };
    let mut filter = EnvFilter::try_from_env("RIDGEWATCH_LOG").unwrap_or_else(|_| EnvFilter::new(level));
    // Below this level they write out what is sent, credentials included.
    for quiet in ["ureq=info", "ureq_proto=info", "rustls=info"] {
        filter = quiet.parse().into_iter().fold(filter, EnvFilter::add_directive);
    }
    let lines = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(stderr)
        .with_ansi(stderr().is_terminal())
        .without_time()
        .with_target(false)
        .compact();
    // Such an error would be printed on standard error, which panics if standard error cannot be written.
    lines.log_internal_errors(false).init();
}

/// Prints why a command failed, in one line.
pub fn fail(error: &anyhow::Error) {
    let mut message = error.to_string();
    for cause in error.chain().skip(1) {
        let cause = cause.to_string();
        // Transparent errors repeat their cause.
        if !message.contains(&cause) {
            message = format!("{message}: {cause}");
        }
    }
    note(message);
}

/// Prints a line of information. Ignores a full disk and a closed pipe.
pub fn note(text: impl std::fmt::Display) {
    let _ = writeln!(stderr(), "ridgewatch: {text}");
}

/// Prints a line of information from a thread of its own, for those who must not wait for standard error. If the system refuses the thread, the line
/// is lost.
pub fn note_aside(text: impl std::fmt::Display) {
    let text = text.to_string();
    let _ = std::thread::Builder::new().spawn(move || note(text));
}

/// A progress bar over `length` steps (a spinner if unknown), drawn only when standard error is a terminal.
pub fn progress(length: Option<u64>) -> ProgressBar {
    let target = if stderr().is_terminal() { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
    let (bar, style) = match length {
        Some(n) => (ProgressBar::new(n), "{bar:30} {pos}/{len} {elapsed_precise} {left}{msg}{work}"),
        None => (ProgressBar::new_spinner(), "{spinner} {pos} {elapsed_precise} {msg}{work}"),
    };
    bar.set_draw_target(target);
    let left = |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        // Before the first step it is not known, and after the last one there may be other work. A text that is not written is not shown.
        let _ = if state.pos() > 0 && state.len().is_none_or(|len| state.pos() < len) {
            write!(out, "eta {:#} ", HumanDuration(state.eta()))
        } else {
            Ok(())
        };
    };
    bar.set_style(with_work(style).with_key("left", left));
    // Keeps its clock running, on a thread, for which indicatif panics if the system refuses one.
    let has_room = || std::thread::Builder::new().spawn(|| ()).is_ok_and(|thread| thread.join().is_ok());
    if stderr().is_terminal() && has_room() {
        bar.enable_steady_tick(std::time::Duration::from_millis(200));
    }
    bar
}

/// A style whose `{work}` is the work in progress that takes more than two seconds, with the share done and the time left.
fn with_work(template: &str) -> ProgressStyle {
    let work = |_: &ProgressState, out: &mut dyn std::fmt::Write| {
        if let Some(words) = work() {
            // A text that is not written is not shown.
            let _ = write!(out, " ({words})");
        }
    };
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()).with_key("work", work)
}

/// A spinner with the elapsed time, for work of unknown length; drawn only when standard error is a terminal.
pub fn spinner(text: String) -> ProgressBar {
    // Clears itself when dropped.
    let bar = progress(None).with_finish(ProgressFinish::AndClear);
    bar.set_style(with_work("{spinner} {elapsed_precise} {msg}{work}"));
    bar.set_message(text);
    bar
}

/// A spinner that also shows the time left of work that ends after `seconds`.
pub fn spinner_within(text: String, seconds: f64) -> ProgressBar {
    let bar = spinner(text);
    let left = move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        // A text that is not written is not shown.
        let _ = write!(out, "at most {:.0} s left", (seconds - state.elapsed().as_secs_f64()).max(0.0));
    };
    bar.set_style(with_work("{spinner} {elapsed_precise} {left} {msg}{work}").with_key("left", left));
    bar
}
