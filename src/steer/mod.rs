//! Commands in: a signed socket for those who steer a run, and its other end.
//!
//! In: messages of clients that know the key of a connection file, described in docs/protocol.md. Out: commands to [`crate::run::Steering`], each of
//! which is answered. Calls `run`, and the crates `ridgewatch-zmtp` and `ridgewatch-wire`.

mod client;
mod error;
mod session;
mod socket;

pub use client::Steerer;
pub use error::SteerError;
pub use session::{Outcome, Refusal};
pub use socket::{CommandSocket, default_connection};
