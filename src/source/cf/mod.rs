//! The CF conventions, as far as velocity fields need them: units, calendars, coordinates, packing, finding the velocity.

pub(super) mod calendar;
pub(super) mod coordinate;
pub(super) mod packing;
pub(super) mod time;
pub(super) mod units;
pub(super) mod velocity;
