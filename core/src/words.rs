//! Words of messages.

use std::fmt::Display;

/// `n` and the noun that it counts: `1 view`, `2 views`; `1 pass`, `2 passes`.
pub fn counted<N: Copy + Display + PartialEq + From<u8>>(n: N, noun: &str) -> String {
    format!("{n} {}", plural(n, noun))
}

/// `noun` as it follows the number `n`.
pub fn plural<N: PartialEq + From<u8>>(n: N, noun: &str) -> String {
    let end = match noun.ends_with('s') {
        _ if n == N::from(1) => "",
        true => "es",
        false => "s",
    };
    format!("{noun}{end}")
}

#[cfg(test)]
mod tests {
    use super::counted;

    #[test]
    fn one_takes_no_s() {
        let all = [counted(0_usize, "view"), counted(1_u64, "view"), counted(1_u16, "pass"), counted(2_u32, "pass")];
        assert_eq!(all, ["0 views", "1 view", "1 pass", "2 passes"]);
    }
}
