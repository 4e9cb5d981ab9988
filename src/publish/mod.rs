//! Output of frames (ZeroMQ, EXR, PNG, records) and comparison of pictures.
//!
//! In: finished frames. Out: files and messages, described in docs/protocol.md. A slow subscriber or a full disk never stops the cycle, which
//! calls [`Output`] alone. This room uses `run` and `render` for their types only.

mod annotate;
mod compare;
mod error;
mod export;
mod exr;
mod file_writer;
mod histogram;
mod message;
mod movie;
mod newest;
mod output;
mod past_run;
mod plane;
mod preview;
mod run_folder;
mod scene;
mod settings;
mod summary;
pub(crate) mod vtk_xml;
mod zmq;

pub use compare::{CompareError, Comparison, compare_files, compare_films};
pub use error::PublishError;
pub(crate) use export::add_mapping;
pub use export::{Field, FieldExport, FieldFormat, FieldFrame, MapAbout, NewestSlide, NoField, SeedField, SlideField, seeds};
pub use exr::{channels_at, decode_exr, encode_exr, exr_claims, read_exr, write_exr};
pub use histogram::{Histogram, histogram};
pub use message::{FRAME_TOPIC, FrameHeader, LAYERS_TOPIC, MAX_LAYERED_PIXELS, PROTOCOL, RECORD_TOPIC, TrustedCells, WORK_TOPIC, WorkMark};
pub use movie::{Filmed, Movie, MovieSettings};
pub use newest::{NewestFrame, NoFrame, RunAbout};
pub use output::Output;
pub use past_run::{PastRun, Picture};
pub use plane::{Layer, PlaneHead, no_error, plane};
pub use preview::{jpeg, png, raw, write_png};
pub use run_folder::{DrawFrame, RunFolder, SlideMap, Written};
pub use scene::{refuse_foreign_scene, write_scene};
pub use settings::{DEFAULT_ENDPOINT, ExrFrames, Payload, Peers, PublishSettings, WhenDiskSlow};
pub use summary::{FileStatistics, MovieStatistics, PublishStatistics, Summary, Totals, peak_memory_bytes};
pub use zmq::Publisher;
