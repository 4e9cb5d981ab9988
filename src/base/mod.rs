//! What every room may use: checks of settings, files written whole, folders held open, memory, signs of progress, and the errors of devices. Uses
//! no other room.

mod device_error;
pub mod files;
pub mod folder;
pub mod memory;
pub mod progress;
pub mod setting;

pub use device_error::DeviceError;
