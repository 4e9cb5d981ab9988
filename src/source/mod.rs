//! Where snapshots come from: closed forms sampled on a grid, NetCDF files.
//!
//! In: settings and files. Out: snapshots in time order, read ahead by one I/O thread. Calls `field`.
