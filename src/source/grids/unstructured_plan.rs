//! Points of a velocity on an unstructured mesh: longitudes and latitudes along one dimension, and the faces between them.
//!
//! Faces are found by the UGRID conventions (`cf_role`), else by the names that FESOM, FVCOM and ICON give them.

use super::curvilinear_plan::{Cells, POINT_BYTES, Pair, Points};
use super::locator::Mesh;
use super::planner::Planner;
use super::triangles::{Faces, Triangles};
use crate::archive_settings::{Metric, VelocityUnit};
use crate::cf::coordinate::{Kind, classify};
use crate::cf::units::Unit;
use crate::cf::velocity::Velocity;
use crate::error::SourceError;
use crate::formats::{Attribute, Listing, Variable};

/// Names of nodes at the corners of faces, for files without `cf_role`.
const FACE_NAMES: [&str; 8] =
    ["nv", "elements", "elem", "element", "face_nodes", "vertex_of_cell", "schism_hgrid_face_nodes", "mesh2d_face_nodes"];
/// Kinds of features along one dimension that are no mesh (CF conventions, chapter 9).
const FEATURES: [&str; 6] = ["point", "timeseries", "trajectory", "profile", "timeseriesprofile", "trajectoryprofile"];
/// Bytes of a corner of a face while faces are read.
const CORNER_BYTES: u64 = 40;
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
        let name = of.name.to_ascii_lowercase();
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
    let mut found: Vec<(usize, Pair)> =
        of(Kind::Longitude).filter_map(|lon| partner(lon).map(|lat| (dimension(lon), [lon, lat]))).collect();
    // Those that a mesh topology of the UGRID conventions names (SCHISM gives them no units).
    for topology in listing.matching(|v: &Variable| v.text("cf_role") == Some("mesh_topology")) {
        for names in ["node_coordinates", "face_coordinates"].iter().filter_map(|attribute| listing.variables[topology].text(attribute)) {
            let pair: Vec<usize> = names.split_whitespace().filter_map(|name| listing.find(name)).collect();
            if let [lon, lat] = pair[..]
                && [lon, lat].iter().all(|&i| listing.variables[i].dimensions.len() == 1 && listing.variables[i].units().is_none())
                && dimension(lon) == dimension(lat)
                && !found.iter().any(|(known, _)| *known == dimension(lon))
            {
                found.push((dimension(lon), [lon, lat]));
            }
        }
    }
    found
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
        let feature = match self.listing().attribute("featureType") {
            Some(Attribute::Text(text)) => text.trim().to_ascii_lowercase(),
            _ => String::new(),
        };
        if FEATURES.contains(&feature.as_str()) {
            return Ok(None);
        }
        let Some(u) = self.mesh_points(velocity.u.variable)? else { return Ok(None) };
        let s = self.settings;
        if let Some(metric) = s.metric.filter(|metric| *metric != Metric::Sphere) {
            return Err(SourceError::setting("metric", format!("{metric:?}"), "\"sphere\", the only one of an unstructured mesh"));
        }
        if s.velocity_unit != VelocityUnit::Si {
            return Err(SourceError::setting("velocity_unit", "cells", "\"si\": an unstructured mesh has no cells to count"));
        }
        let mut found = vec![u];
        let dimensions = |i: usize| &self.variable(i).dimensions;
        for other in [Some(&velocity.v), velocity.w.as_ref()].into_iter().flatten() {
            // Faces are read once.
            if dimensions(other.variable) == dimensions(velocity.u.variable)
                && self.file.origin(other.variable).0 == self.file.origin(velocity.u.variable).0
            {
                found.push(u);
                continue;
            }
            let lost = || self.misfit(other.variable, "it lies on no points of the mesh on which u lies");
            found.push(self.mesh_points(other.variable)?.ok_or_else(lost)?);
        }
        let turned_back = self.listing().attribute("FESOM_autorotate_back_to_geo");
        if turned_back.is_some_and(|a| {
            matches!(a, Attribute::Numbers(_, v) if v.first() == Some(&0.0))
                || matches!(a, Attribute::Text(t) if ["0", "F", ".false."].contains(&t.trim()))
        }) {
            self.note(
                "WARNING: FESOM wrote these vectors along its own rotated axes (`FESOM_autorotate_back_to_geo` is 0); they are read as east and north: turn \
                 them first, or write them with `vec_autorotate = .true.`",
            );
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

    /// True along the points or the faces of a mesh.
    pub fn is_along_mesh(&self, dimension: usize) -> bool {
        let listing = self.listing();
        pairs(listing).iter().any(|(d, _)| *d == dimension) || connectivities(listing).iter().any(|c| c.faces == dimension)
    }

    fn mesh_points(&self, variable: usize) -> Result<Option<Points>, SourceError> {
        let listing = self.listing();
        let (mut pairs, faces) = (pairs(listing), connectivities(listing));
        // Those that are named go first.
        pairs.splice(..0, self.named_points().map(|pair| (self.variable(pair[0]).dimensions[0], pair)));
        let length = |d: usize| listing.dimensions[d].len;
        let pair_on = |dimension: usize| pairs.iter().find(|(d, _)| *d == dimension).map(|(_, pair)| *pair);
        let location = self.variable(variable).text("location").unwrap_or_default();
        // The last dimension that fits: times and levels come before it, or levels after it.
        for &dimension in self.variable(variable).dimensions.iter().rev() {
            if length(dimension) < 3 || self.measured(dimension).kind == Kind::Time {
                continue;
            }
            let own = pair_on(dimension);
            // The dimension of the mesh may have another name in a file of its own.
            let is_elsewhere = |c: &Connectivity| self.file.origin(c.variable).0 != self.file.origin(variable).0;
            let same_length = |c: &&Connectivity| (own.is_some() || is_elsewhere(c)) && length(c.faces) == length(dimension);
            let around =
                faces.iter().find(|c| c.faces == dimension).or_else(|| faces.iter().find(same_length)).filter(|_| location != "node");
            if own.is_none() && around.is_none() {
                continue;
            }
            if location == "edge" {
                return Err(self.misfit(variable, "its values lie at the sides of faces; accepted are values at nodes and in faces"));
            }
            if let Some(of) = around
                && let Some((nodes_on, nodes)) = self.nodes_of(*of, &pairs)?
                && nodes_on != dimension
            {
                let cells = Cells::InFaces { faces: of.variable, nodes };
                return Ok(Some(Points { pair: own.unwrap_or(nodes), plane: [dimension; 2], between: [false; 2], shift: [0; 2], cells }));
            }
            let Some(pair) = own else { continue };
            let metres = |i: &usize| Unit::parse(self.variable(*i).units().unwrap_or_default()).is_some_and(|u| u.is_length());
            if let Some(&odd) = pair.iter().find(|i| metres(i)) {
                return Err(self.misfit(odd, "points of an unstructured mesh have to be longitudes and latitudes in degrees or radians"));
            }
            let mut cells = Cells::Unknown;
            for of in faces.iter().filter(|c| c.faces != dimension && location != "face") {
                if self.nodes_of(*of, &pairs)?.is_some_and(|(on, _)| on == dimension) {
                    cells = Cells::AtNodes { faces: of.variable };
                    break;
                }
            }
            return Ok(Some(Points { pair, plane: [dimension; 2], between: [false; 2], shift: [0; 2], cells }));
        }
        Ok(None)
    }

    /// Dimension and coordinates of the nodes of faces: those of the fewest points among which all corners are.
    fn nodes_of(&self, of: Connectivity, pairs: &[(usize, Pair)]) -> Result<Option<(usize, Pair)>, SourceError> {
        let greatest = self.corners(of)?.into_iter().flatten().max();
        let Some(greatest) = greatest.map(|node| node as usize) else { return Ok(None) };
        let length = |d: usize| self.listing().dimensions[d].len;
        let fitting = pairs.iter().filter(|(d, _)| *d != of.faces && greatest < length(*d));
        Ok(fitting.min_by_key(|(d, _)| length(*d)).copied())
    }

    /// Nodes at the corners of all faces, counted from 0, face after face.
    fn corners(&self, of: Connectivity) -> Result<Vec<Option<u32>>, SourceError> {
        let (variable, listing) = (self.variable(of.variable), self.listing());
        let [faces, width] = [of.faces, of.corners].map(|d| listing.dimensions[d].len);
        listing.check_count(variable, &[faces, width])?;
        self.check_room(of.variable, faces.saturating_mul(width), CORNER_BYTES)?;
        let packing = self.packing(of.variable)?;
        let mut values: Vec<f64> = self.file.read_all(of.variable)?.into_iter().map(|v| packing.unpack(v)).collect();
        if variable.dimensions[0] == of.corners {
            values = (0..faces).flat_map(|face| (0..width).map(move |k| k * faces + face)).map(|n| values[n]).collect();
        }
        let known = |v: &&f64| v.is_finite() && **v >= 0.0;
        let (least, greatest) = values.iter().filter(known).fold((f64::INFINITY, 0.0f64), |(a, b), &v| (a.min(v), b.max(v)));
        // Models count from 1, unless a 0 is there which does not only fill up faces of fewer corners.
        let is_full = || pairs(listing).iter().any(|(d, _)| *d != of.faces && listing.dimensions[*d].len as f64 == greatest);
        let stated = variable.numbers("start_index").first().copied();
        let start = stated.unwrap_or_else(|| if least == 0.0 && !is_full() { 0.0 } else { 1.0 });
        let node = |v: f64| {
            let node = v - start;
            (node >= 0.0 && node < f64::from(u32::MAX) && node.fract() == 0.0).then_some(node as u32)
        };
        Ok(values.into_iter().map(node).collect())
    }

    fn check_room(&self, variable: usize, points: usize, each: u64) -> Result<(), SourceError> {
        let needed = (points as u64).saturating_mul(each);
        self.file.limits.check(needed, &format!("{points} points of a mesh")).map_err(|what| self.misfit(variable, what))
    }

    /// Longitudes and latitudes of a pair.
    fn places(&self, [longitude, latitude]: Pair) -> Result<[Vec<f64>; 2], SourceError> {
        for index in [longitude, latitude] {
            let shape = self.shape(index);
            self.listing().check_count(self.variable(index), &shape)?;
            self.check_room(index, shape[0], POINT_BYTES)?;
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
