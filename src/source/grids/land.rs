//! Points of a component that lie on land.

/// Points of one component on land, by their indices in the file.
#[derive(Debug, PartialEq)]
pub struct Mask {
    /// Variable, or what stands for one.
    pub name: String,
    /// Entries along x, y and the levels; 1 if it holds for all levels.
    shape: [usize; 3],
    land: Vec<bool>,
}

impl Mask {
    pub fn new(name: &str, shape: [usize; 3], land: Vec<bool>) -> Self {
        Self { name: name.into(), shape, land }
    }

    pub fn is_land(&self, place: [usize; 3]) -> bool {
        let [x, y, z] = [0, 1, 2].map(|k| if self.shape[k] == 1 { 0 } else { place[k] });
        self.land[(z * self.shape[1] + y) * self.shape[0] + x]
    }

    /// True if it is for points of this shape.
    pub fn fits(&self, shape: [usize; 3]) -> bool {
        self.shape == shape
    }

    /// Share of the points on land.
    pub fn share(&self) -> f64 {
        self.land.iter().filter(|land| **land).count() as f64 / self.land.len().max(1) as f64
    }
}
