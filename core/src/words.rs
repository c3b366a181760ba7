//! Words of messages.

/// `noun` as it follows the number `n`: `1 view`, `2 views`; `1 pass`, `2 passes`.
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
    use super::plural;

    #[test]
    fn one_takes_no_s() {
        let all = [plural(0_usize, "view"), plural(1_u64, "view"), plural(1_u16, "pass"), plural(2_u32, "pass")];
        assert_eq!(all, ["views", "view", "pass", "passes"]);
    }
}
