//! One open file of some format, inside this room.

use super::messages::Variable;

/// Reads values of an open file.
pub trait Store: Send {
    /// Appends a hyperslab to `out` as `f64`. `index` is the variable's place in the listing. The caller has checked that the
    /// block lies inside the variable's shape and holds at least one value.
    ///
    /// # Errors
    /// Error message of the library or of the operating system.
    fn read(&self, index: usize, variable: &Variable, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String>;
}

/// Advances an index in row-major order; false after the last.
pub fn advance(index: &mut [usize], count: &[usize]) -> bool {
    for k in (0..index.len()).rev() {
        index[k] += 1;
        if index[k] < count[k] {
            return true;
        }
        index[k] = 0;
    }
    false
}
