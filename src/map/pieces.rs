//! Connected pieces of a triangle mesh.

use rayon::prelude::*;

/// A side of a triangle: its vertices, the smaller number first, the triangle, and whether the triangle passes them in this order.
type Side = ([u32; 2], u32, bool);

/// Pieces that hang together by sides of triangles. In a piece, triangles turn the same way round, if it has two sides.
pub(super) fn pieces(triangles: &[[u32; 3]]) -> Vec<Vec<[u32; 3]>> {
    let mut sides: Vec<Side> = triangles
        .par_iter()
        .enumerate()
        .flat_map_iter(|(number, [a, b, c])| [[*a, *b], [*b, *c], [*c, *a]].map(|[p, q]| ([p.min(q), p.max(q)], number as u32, p < q)))
        .collect();
    sides.par_sort_unstable();
    // Neighbours of each triangle, and whether it turns the other way round.
    let mut neighbours = vec![[None; 3]; triangles.len()];
    for shared in sides.chunk_by(|a, b| a.0 == b.0) {
        if let [(_, one, first), (_, other, second)] = shared {
            for (of, there) in [(*one, *other), (*other, *one)] {
                if let Some(free) = neighbours[of as usize].iter_mut().find(|place| place.is_none()) {
                    *free = Some((there as usize, first == second));
                }
            }
        }
    }
    // Whether each triangle that was reached has to be turned.
    let mut turned: Vec<Option<bool>> = vec![None; triangles.len()];
    let mut found = Vec::new();
    for start in 0..triangles.len() {
        if turned[start].is_some() {
            continue;
        }
        turned[start] = Some(false);
        let mut piece = Vec::new();
        let mut open = vec![(start, false)];
        while let Some((number, is_turned)) = open.pop() {
            let [a, b, c] = triangles[number];
            piece.push(if is_turned { [a, c, b] } else { [a, b, c] });
            for (next, is_opposite) in neighbours[number].iter().flatten() {
                if turned[*next].is_none() {
                    turned[*next] = Some(is_turned ^ is_opposite);
                    open.push((*next, is_turned ^ is_opposite));
                }
            }
        }
        found.push(piece);
    }
    found
}
