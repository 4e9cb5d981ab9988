//! Points of a velocity on an unstructured mesh: longitudes and latitudes along one dimension, and the faces between them.
//!
//! Faces are found by the UGRID conventions (`cf_role`), else by the names that FESOM, FVCOM and ICON give them.

use super::curvilinear_plan::{Cells, POINT_BYTES, Pair, Points};
use super::locator::Mesh;
use super::planner::Planner;
use super::triangles::{Faces, Triangles};
use crate::cf::coordinate::{Kind, classify};
use crate::cf::units::Unit;
use crate::cf::velocity::Velocity;
use crate::error::SourceError;
use crate::formats::{Listing, Variable};

/// Names of nodes at the corners of faces, for files without `cf_role`.
const FACE_NAMES: [&str; 8] =
    ["nv", "elements", "elem", "element", "face_nodes", "vertex_of_cell", "schism_hgrid_face_nodes", "mesh2d_face_nodes"];
/// Corners that a face may have.
const CORNERS: std::ops::RangeInclusive<usize> = 3..=16;

/// Nodes at the corners of faces.
#[derive(Debug, Clone, Copy)]
struct Connectivity {
    variable: usize,
    faces: usize,
    corners: usize,
}

/// Variables of nodes at the corners of faces.
fn connectivities(listing: &Listing) -> Vec<Connectivity> {
    let found = |variable: usize| {
        let of = &listing.variables[variable];
        // The file that it comes from may follow its name.
        let name = of.name.split(' ').next().unwrap_or_default().to_ascii_lowercase();
        let named = of.text("cf_role").map_or_else(|| FACE_NAMES.contains(&name.as_str()), |role| role == "face_node_connectivity");
        let [a, b] = of.dimensions[..] else { return None };
        let (corners, faces) = if listing.dimensions[a].len < listing.dimensions[b].len { (a, b) } else { (b, a) };
        let fits = named && of.number.is_number() && CORNERS.contains(&listing.dimensions[corners].len);
        fits.then_some(Connectivity { variable, faces, corners })
    };
    (0..listing.variables.len()).filter_map(found).collect()
}

/// Longitudes and latitudes along one dimension that both have.
fn pairs(listing: &Listing) -> Vec<(usize, Pair)> {
    let of = |kind: Kind| listing.matching(move |v: &Variable| v.dimensions.len() == 1 && v.number.is_number() && classify(v) == kind);
    let dimension = |i: usize| listing.variables[i].dimensions[0];
    let partner = |longitude: usize| of(Kind::Latitude).find(|&latitude| dimension(latitude) == dimension(longitude));
    of(Kind::Longitude).filter_map(|lon| partner(lon).map(|lat| (dimension(lon), [lon, lat]))).collect()
}

/// True if a file has faces, or longitudes and latitudes along one dimension.
pub fn holds_mesh(listing: &Listing) -> bool {
    !connectivities(listing).is_empty() || !pairs(listing).is_empty()
}

impl Planner<'_> {
    /// Longitudes and latitudes along one dimension that the settings name.
    pub fn named_points(&self) -> Option<Pair> {
        let index = |name: &Option<String>| name.as_ref().and_then(|name| self.listing().find(name));
        let pair = [index(&self.settings.x)?, index(&self.settings.y)?];
        let [x, y] = pair.map(|i| &self.variable(i).dimensions[..]);
        (x.len() == 1 && x == y && pair[0] != pair[1]).then_some(pair)
    }

    /// Points of each component on an unstructured mesh. `None` if u lies on none.
    ///
    /// # Errors
    /// A mesh that cannot be read, or is not in degrees; v or w that lie on no mesh.
    pub fn unstructured_points(&mut self, velocity: &Velocity) -> Result<Option<Vec<Points>>, SourceError> {
        let Some(u) = self.mesh_points(velocity.u.variable)? else { return Ok(None) };
        let mut found = vec![u];
        for other in [Some(&velocity.v), velocity.w.as_ref()].into_iter().flatten() {
            let lost = || self.misfit(other.variable, "it lies on no points of the mesh on which u lies");
            found.push(self.mesh_points(other.variable)?.ok_or_else(lost)?);
        }
        if found[0].cells == Cells::Unknown {
            let [longitude, latitude] = found[0].pair.map(|i| self.variable(i).name.clone());
            self.note(format!(
                "no faces are known between the points of `{longitude}` and `{latitude}`: triangles with sides much longer than others beside them are \
                 taken as land; name the file of the mesh too if there is one"
            ));
        }
        Ok(Some(found))
    }

    fn mesh_points(&self, variable: usize) -> Result<Option<Points>, SourceError> {
        let listing = self.listing();
        let (pairs, faces) = (pairs(listing), connectivities(listing));
        let named = self.named_points();
        let pair_on = |dimension: usize| {
            let named = named.filter(|pair| self.variable(pair[0]).dimensions == [dimension]);
            named.or_else(|| pairs.iter().find(|(d, _)| *d == dimension).map(|(_, pair)| *pair))
        };
        // The last dimension that fits: before it come times and levels.
        for &dimension in self.variable(variable).dimensions.iter().rev() {
            if listing.dimensions[dimension].len < 3 || self.measured(dimension).kind == Kind::Time {
                continue;
            }
            let own = pair_on(dimension);
            // Of nodes and faces of one number, the names of dimensions tell.
            if let Some(of) = faces.iter().find(|c| c.faces == dimension)
                && let Some((nodes, greatest)) = self.nodes_of(*of, dimension, &pairs)?
            {
                self.check_room(of.variable, greatest)?;
                let cells = Cells::InFaces { faces: of.variable, nodes };
                return Ok(Some(Points { pair: own.unwrap_or(nodes), plane: [dimension; 2], between: [false; 2], cells }));
            }
            let Some(pair) = own else { continue };
            let metres = |i: &usize| Unit::parse(self.variable(*i).units().unwrap_or_default()).is_some_and(|u| u.is_length());
            if let Some(&odd) = pair.iter().find(|i| metres(i)) {
                return Err(self.misfit(odd, "points of an unstructured mesh have to be longitudes and latitudes in degrees or radians"));
            }
            let mut cells = Cells::Unknown;
            for of in faces.iter().filter(|c| c.faces != dimension) {
                if self.greatest(*of)?.is_some_and(|greatest| greatest < listing.dimensions[dimension].len) {
                    cells = Cells::AtNodes { faces: of.variable };
                }
            }
            return Ok(Some(Points { pair, plane: [dimension; 2], between: [false; 2], cells }));
        }
        Ok(None)
    }

    /// Coordinates of the nodes of faces, and the number of the last node that a face has.
    fn nodes_of(&self, of: Connectivity, faces: usize, pairs: &[(usize, Pair)]) -> Result<Option<(Pair, usize)>, SourceError> {
        let Some(greatest) = self.greatest(of)? else { return Ok(None) };
        let length = |d: usize| self.listing().dimensions[d].len;
        let fitting = pairs.iter().filter(|(d, _)| *d != faces && greatest < length(*d));
        Ok(fitting.min_by_key(|(d, _)| length(*d)).map(|(_, pair)| (*pair, greatest)))
    }

    /// The greatest number of a node at a corner, counted from 0.
    fn greatest(&self, of: Connectivity) -> Result<Option<usize>, SourceError> {
        Ok(self.corners(of)?.into_iter().flatten().max().map(|node| node as usize))
    }

    /// Nodes at the corners of all faces, counted from 0, face after face.
    fn corners(&self, of: Connectivity) -> Result<Vec<Option<u32>>, SourceError> {
        let (variable, listing) = (self.variable(of.variable), self.listing());
        let [faces, width] = [of.faces, of.corners].map(|d| listing.dimensions[d].len);
        listing.check_count(variable, &[faces, width])?;
        self.check_room(of.variable, faces.saturating_mul(width))?;
        let packing = self.packing(of.variable)?;
        let mut values: Vec<f64> = self.file.read_all(of.variable)?.into_iter().map(|v| packing.unpack(v)).collect();
        if variable.dimensions[0] == of.corners {
            values = (0..faces).flat_map(|face| (0..width).map(move |k| k * faces + face)).map(|n| values[n]).collect();
        }
        let known = |v: &&f64| v.is_finite() && **v >= 0.0;
        let least = values.iter().filter(known).fold(f64::INFINITY, |a, &b| a.min(b));
        // Models count from 1, unless a 0 is there: then it may fill up faces of fewer corners only where the conventions are followed.
        let stated = variable.numbers("start_index").first().copied();
        let start = stated.unwrap_or(if least == 0.0 { 0.0 } else { 1.0 });
        let node = |v: f64| {
            let node = v - start;
            (node >= 0.0 && node < f64::from(u32::MAX) && node.fract() == 0.0).then_some(node as u32)
        };
        Ok(values.into_iter().map(node).collect())
    }

    fn check_room(&self, variable: usize, points: usize) -> Result<(), SourceError> {
        let needed = (points as u64).saturating_mul(POINT_BYTES);
        self.file.limits.check(needed, &format!("{points} points of a mesh")).map_err(|what| self.misfit(variable, what))
    }

    /// Longitudes and latitudes of a pair.
    fn places(&self, [longitude, latitude]: Pair) -> Result<[Vec<f64>; 2], SourceError> {
        for index in [longitude, latitude] {
            let shape = self.shape(index);
            self.listing().check_count(self.variable(index), &shape)?;
            self.check_room(index, shape[0])?;
        }
        let places = [self.degrees(longitude, None)?, self.degrees(latitude, None)?];
        self.check_latitudes(latitude, &places[1])?;
        Ok(places)
    }

    /// The mesh of points without rows.
    ///
    /// # Errors
    /// Values that cannot be read; points without a triangle.
    pub fn unstructured_mesh(&self, points: &Points) -> Result<Mesh, SourceError> {
        let faces = |variable: usize, nodes: [Vec<f64>; 2]| {
            let of = connectivities(self.listing()).into_iter().find(|c| c.variable == variable);
            let of = of.ok_or_else(|| self.misfit(variable, "its faces are gone"))?;
            Ok::<Faces, SourceError>(Faces::new(nodes, &self.corners(of)?, self.listing().dimensions[of.corners].len))
        };
        let ([longitude, latitude], triangles) = match points.cells {
            Cells::AtNodes { faces: variable } => {
                let places = self.places(points.pair)?;
                let faces = faces(variable, places.clone())?;
                (places, Triangles::of_faces(faces))
            }
            Cells::InFaces { faces: variable, nodes } => {
                let faces = faces(variable, self.places(nodes)?)?;
                let [longitude, latitude] = if points.pair == nodes { faces.middles() } else { self.places(points.pair)? };
                let triangles = Triangles::between_faces(&longitude, &latitude, faces);
                ([longitude, latitude], triangles)
            }
            Cells::Rows | Cells::Unknown => {
                let [longitude, latitude] = self.places(points.pair)?;
                let triangles = Triangles::without_gaps(&longitude, &latitude);
                ([longitude, latitude], triangles)
            }
        };
        Ok(Mesh { shape: [longitude.len(), 1], longitude, latitude, triangles: Some(triangles) })
    }

    /// Refuses a later file whose mesh differs from that of the first.
    pub fn check_unstructured(&self, points: &Points, first: &Mesh) -> Result<(), SourceError> {
        let known = match (points.cells, first.triangles.as_ref().and_then(Triangles::nodes)) {
            (Cells::InFaces { nodes, .. }, Some(known)) if points.pair == nodes => [&known[0], &known[1]],
            _ => [&first.longitude, &first.latitude],
        };
        for ((&variable, here), known) in points.pair.iter().zip(self.places(points.pair)?).zip(known) {
            if let Some(n) = here.iter().zip(known).position(|(a, b)| a != b && !(a.is_nan() && b.is_nan())) {
                let what =
                    format!("entry {n} is {} where the first file has {}; the files of an archive lie on one mesh", here[n], known[n]);
                return Err(self.misfit(variable, what));
            }
        }
        Ok(())
    }
}
